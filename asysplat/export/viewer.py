"""A viewer in the browser: the server renders each open page's camera.

asysplat view scene.ply [PHOTOGRAPHS]
"""

from argparse import ArgumentParser

if __name__ == "__main__":  # now, since torch takes seconds
    parser = ArgumentParser("asysplat view", description=__doc__.split("\n")[0])
    parser.add_argument("scene", help="a file of Gaussians")
    parser.add_argument("photographs", nargs="?", help="a folder to show the scene among")
    arguments = parser.parse_args()

import math
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from numpy import ndarray
from torch import Tensor

from asysplat.data.normalize import normalize
from asysplat.data.photographs import open_photographs
from asysplat.errors import InputError
from asysplat.export import viewer_cameras
from asysplat.export.gaussians import camera_before, cameras_beside, read_gaussians, read_notes
from asysplat.export.page import BLACK
from asysplat.interrupts import handle_signals
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views, decode, inverse_depths

if TYPE_CHECKING:
    import viser  # an optional dependency

OWN_PAGES = re.compile(r"https?://(127\.0\.0\.1|localhost)(:\d+)?")
LAYERS = ("color", "depth", "alpha")
FRUSTUM_LENGTH = 0.1  # in the page's unit
FRUSTUM_HEIGHT = 128  # pixels of its image, in the command
MAX_SAMPLES = 10_000  # pixels from which the range of disparities is computed
WAITING = "Waiting for the first rendering; kernels may have to compile, for minutes."
POLL_SECONDS = 0.01  # between two checks for changes
TARGET_SECONDS = 0.05  # target duration of a rendering while something changes
REST_SECONDS = 0.2  # without a change, before rendering at full resolution
MIN_PIXELS, MAX_PIXELS = 320 * 200, 1920 * 1080  # bounds of a rendering's size


@dataclass
class Page:
    """The rendering state of an open page."""

    state: object = None  # what was rendered last
    pixels: int = MAX_PIXELS // 16  # size of a rendering while something changes
    due: float = math.inf  # time of the rendering at full resolution
    seconds: float = 0.0  # duration of the last rendering at full resolution


class Viewer:
    """Show Gaussians in the browser, among the input cameras and images.

    Each page that opens `url` has its own camera; the panel's settings hold for all pages. A click
    on a camera moves the page's camera there.

    Args:
        views: input views, [V]; of images of one pixel, frames alone are drawn.
        gaussians: [N]; None to `show` them later.
        port: the next free one is used if it is taken; 0: any free one.
        background: RGB behind the Gaussians.
    """

    def __init__(
        self,
        views: Views,
        gaussians: Gaussians | None = None,
        port: int = 8080,
        antialiased: bool = False,
        background: Sequence[float] = BLACK,
    ):
        try:
            import viser
        except ImportError as error:
            raise InputError("The viewer needs viser: pip install 'viser>=1.1'.") from error
        _check_one_scene("views", views.images.shape[:-4])
        if gaussians is not None:
            _check_one_scene("gaussians", gaussians.opacities.shape[:-1])
        views = Views(views.cameras, views.images).to("cpu")
        # A browser's near plane, navigation and float32 suit a scene of about size 1 only.
        views, _, self._frame = normalize(views, views)
        self._cameras, self._background = views.cameras, background
        self._up = viewer_cameras.mean_up(self._cameras)
        self._scene: tuple[Gaussians | None, str] = (None, WAITING)
        self._version = object()
        self._closed = Event()
        with _own_pages_only():
            self._server = viser.ViserServer("127.0.0.1", port, label="asysplat", verbose=False)
        self._add_panel(antialiased)
        self._add_cameras(views.images)
        if gaussians is not None:
            self.show(gaussians)
        first = self._server.initial_camera
        first.position, first.look_at, first.up, first.fov = self._pose(0)
        # At an input camera, its own image must not hide the scene.
        first.near = 1.5 * FRUSTUM_LENGTH
        self._thread = Thread(target=self._render_pages, name="asysplat-viewer", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return f"http://127.0.0.1:{self._server.get_port()}"

    def show(self, gaussians: Gaussians, text: str = "") -> None:
        """Show other Gaussians, [N], and Markdown in the panel, at once; any thread may call it."""
        _check_one_scene("gaussians", gaussians.opacities.shape[:-1])
        # Copied, as kernels run without bounds checks: their inputs must not change meanwhile.
        with torch.no_grad():
            shown = self._frame.to_network(gaussians).map(lambda field: field.float().clone())
        self._scene = (shown, text)
        degree = math.isqrt(gaussians.sh.shape[-2]) - 1
        if degree != self._sh_degree.max:
            self._sh_degree.max = self._sh_degree.value = degree
        self._change()

    def wait(self) -> None:
        """Block until Ctrl-C, or until the viewer is closed."""
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop the server, after the current rendering."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._thread.join()
        self._server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_panel(self, antialiased: bool) -> None:
        gui = self._server.gui
        # The share button would open the viewer to anyone, through a server of viser's.
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._layer = gui.add_dropdown("Layer", LAYERS)
        # A float: viser could not send on to other pages the whole number of any float.
        self._sh_degree = gui.add_slider("SH degree", 0.0, 3.0, 1.0, 3.0)
        self._min_opacity = gui.add_slider("Minimum opacity", 0.0, 1.0, 0.01, 0.0)
        self._size = gui.add_slider("Size", 0.05, 1.0, 0.05, 1.0)
        self._antialiased = gui.add_checkbox("Antialiased", antialiased)
        sliders = (self._sh_degree, self._min_opacity, self._size)
        self._settings = (self._layer, *sliders, self._antialiased)
        for handle in self._settings:
            handle.on_update(lambda _: self._change())
        self._show_cameras = gui.add_checkbox("Cameras", True)
        self._text = gui.add_markdown(WAITING)

    def _add_cameras(self, images: Float[Tensor, "V 3 H W"]) -> None:
        scene = self._server.scene
        scene.set_up_direction(self._up.numpy())
        parent = scene.add_frame("/cameras", show_axes=False)
        for view in range(self._cameras.num_views):
            fov, aspect = viewer_cameras.field_of_view(self._cameras, view)
            frustum = scene.add_camera_frustum(
                f"/cameras/{view}",
                fov=fov,
                aspect=aspect,
                # viser's scale is the cube root of the frustum's volume, not its length.
                scale=FRUSTUM_LENGTH * (aspect * math.tan(fov / 2) ** 2 / 3) ** (1 / 3),
                thickness=1.5,
                thickness_units="screen",
                color=(209, 98, 45),
                image=_bytes(decode(images[view])) if images[view, 0].numel() > 1 else None,
                wxyz=viewer_cameras.quaternion(self._cameras, view),
                position=self._cameras.centers[view].numpy(),
            )
            frustum.on_click(self._click)
        self._show_cameras.on_update(lambda _: setattr(parent, "visible", self._show_cameras.value))

    def _click(self, event: "viser.SceneNodePointerEvent") -> None:
        # The browser also reports clicks on frustums before its near plane, which are invisible.
        camera, _ = viewer_cameras.client_camera(event.client.camera, MAX_PIXELS)
        start, ray = (torch.tensor(v).float() for v in (event.ray_origin, event.ray_direction))
        to_near = event.client.camera.near / (ray @ camera.cam_to_world[0, :3, 2])
        view = viewer_cameras.clicked_camera(self._cameras, FRUSTUM_LENGTH, start, to_near * ray)
        if view is not None:
            page = event.client.camera
            with event.client.atomic():
                page.position, page.look_at, page.up_direction, page.fov = self._pose(view)

    def _pose(self, view: int) -> tuple:
        """Return position, look-at, up (the scene's, with the camera's roll) and field of view.

        Navigation turns around look-at: a point at the median distance of the Gaussians.
        """
        right, _, forward = self._cameras.cam_to_world[view, :3, :3].unbind(-1)
        position, distance, (gaussians, _) = self._cameras.centers[view], 1.0, self._scene
        if gaussians is not None:
            distance = (gaussians.means.cpu() - position).norm(dim=-1).median()
        up = self._up - (self._up @ right) * right
        fov, _ = viewer_cameras.field_of_view(self._cameras, view)
        return position.numpy(), (position + distance * forward).numpy(), up.numpy(), fov

    def _change(self) -> None:
        self._version = object()

    def _render_pages(self) -> None:
        """Render each open page: coarsely after a change, and in full once nothing changes."""
        pages: dict[int, Page] = {}
        while not self._closed.wait(POLL_SECONDS):
            for key, client in self._server.get_clients().items():
                page, start = pages.setdefault(key, Page()), time.perf_counter()
                state = (client.camera.update_timestamp, self._version)
                changed = state != page.state
                if not changed and start < page.due:
                    continue
                page.state, page.due = state, math.inf
                in_full = self._draw(client, page.pixels if changed else MAX_PIXELS)
                seconds = time.perf_counter() - start
                if not changed:
                    page.seconds = seconds
                    continue
                factor = min(max(TARGET_SECONDS / seconds, 0.5), 2)
                page.pixels = round(min(max(factor * page.pixels, MIN_PIXELS), MAX_PIXELS))
                if not in_full:  # the pause leaves the machine at least half of its time
                    page.due = start + seconds + max(REST_SECONDS, page.seconds)

    def _draw(self, client: "viser.ClientHandle", max_pixels: int) -> bool:
        """Render a page's camera and send the image; return whether at full resolution."""
        start = time.perf_counter()
        gaussians, text = self._scene
        if gaussians is None:
            return True
        try:
            camera, in_full = viewer_cameras.client_camera(client.camera, max_pixels)
            image = draw_layer(gaussians, camera, **self._options())
            if client.client_id not in self._server.get_clients():  # closed meanwhile
                return True
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
            client.flush()
        except Exception as error:  # nothing reads this thread's errors but the panel
            self._text.content = f"**{type(error).__name__}:** {error}"
            return True
        self._text.content = (
            f"{gaussians.num_gaussians:,} Gaussians, {camera.width} x {camera.height} pixels in "
            f"{1000 * (time.perf_counter() - start):.0f} ms\n\n{text}"
        )
        return in_full

    def _options(self) -> dict[str, Any]:
        """Return the options of `draw_layer`, valid whatever a page has sent."""
        return {
            "layer": self._layer.value if self._layer.value in LAYERS else LAYERS[0],
            "sh_degree": round(_bounded(self._sh_degree)),
            "min_opacity": _bounded(self._min_opacity),
            "size": _bounded(self._size),
            "antialiased": self._antialiased.value,
            "background": self._background,
        }


@contextmanager
def _own_pages_only() -> Iterator[None]:
    """Let servers that start in this context refuse connections of pages from other sites."""
    from websockets.asyncio import server

    serve = server.serve
    # Programs send no origin; viser has no option for it.
    server.serve = partial(serve, origins=[OWN_PAGES, None])
    try:
        yield
    finally:
        server.serve = serve


@torch.no_grad()
def draw_layer(
    gaussians: Gaussians,
    camera: Cameras,
    layer: str = "color",
    sh_degree: int = 3,
    min_opacity: float = 0.0,
    size: float = 1.0,
    antialiased: bool = False,
    background: Sequence[float] = BLACK,
) -> UInt8[ndarray, "H W 3"]:
    """Render one of LAYERS as colors, depths as disparities; `size` is a factor of the scales."""
    opacities = gaussians.opacities.where(gaussians.opacities >= min_opacity, 0)
    gaussians = replace(gaussians, scales=size * gaussians.scales, opacities=opacities)
    options = {"sh_degree": sh_degree, "antialiased": antialiased, "depth": layer == "depth"}
    behind = gaussians.means.new_tensor(background)
    rendering = render(gaussians, camera.to(behind.device), behind, **options)
    if layer == "depth":
        values = inverse_depths(rendering.depth[0])
        sample = values.flatten()[:: 1 + values.numel() // MAX_SAMPLES]
        values = values / sample.quantile(0.99).clamp_min(1e-12)
        colors = colormaps["viridis"](np.arange(256), bytes=True)[:, :3]
        return colors[(255 * values.clamp(0, 1)).round().byte().cpu().numpy()]
    alpha = rendering.alpha[0].expand(3, -1, -1)
    return _bytes(alpha if layer == "alpha" else rendering.image[0].clamp(0, 1))


def _bounded(slider: "viser.GuiSliderHandle[float]") -> float:
    return float(np.clip(np.nan_to_num(slider.value), slider.min, slider.max))


def _bytes(image: Float[Tensor, "3 H W"]) -> UInt8[ndarray, "H W 3"]:
    return (255 * image).round().byte().permute(1, 2, 0).cpu().numpy()


def _check_one_scene(name: str, batch: tuple[int, ...]) -> None:
    if batch:
        raise InputError(
            f"The viewer's {name} have the batch dimensions {tuple(batch)}: give one scene's."
        )


def main(scene: str, folder: str | None) -> None:
    """Show a file of Gaussians, among the photographs of a folder or the cameras beside it."""
    try:
        if folder is not None:
            photographs = open_photographs(folder, height=FRUSTUM_HEIGHT)
            gaussians = read_gaussians(scene, photographs.origin)
            views, gaussians = photographs.inputs, photographs.normalization.to_network(gaussians)
        else:
            gaussians = read_gaussians(scene)
            cameras = cameras_beside(Path(scene), gaussians) or camera_before(gaussians)
            views = Views(cameras.resized(1, 1), torch.zeros(cameras.num_views, 3, 1, 1))
        with Viewer(views, gaussians, **read_notes(Path(scene)).look) as viewer:
            print(f"viewer: {viewer.url}, until Ctrl-C")
            viewer.wait()
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    handle_signals()
    main(arguments.scene, arguments.photographs)
