"""A scene in the browser: the server renders what the camera of each open page sees."""

import math
import time
from threading import Event
from typing import Any

import torch
from numpy import ndarray

from asysplat.errors import InputError
from asysplat.export.frame import (
    Frame,
    camera_of,
    distance_along,
    field_of_view,
    frustum_length,
    mean_up,
    pointed_at,
    quaternion,
)
from asysplat.export.layers import LAYERS, Look, draw, photograph_at, thumbnail
from asysplat.export.page import MOST_PIXELS, Page
from asysplat.scene import Gaussians, Views

IN_ONE_PLACE = 1e-3  # how near a camera stands to where a photograph was taken
WAITING = "Waiting for the first picture; where the renderer compiles for it, that takes minutes."
NO_PHOTOGRAPH = "To see the error, click a camera: it is known where a photograph was taken."


class Viewer:
    """Show a scene of Gaussians in the browser, among the photographs that it was made from.

    Each page that opens `url` has a camera of its own; what is chosen in the panel holds for all.
    Pictures are coarse while something changes, and in full once it rests. A click on a camera
    leads there. The page works in the units of `Frame`, so scenes may be of any size.

        with Viewer(views, gaussians) as viewer:
            viewer.wait()

    Args:
        views: the photographs, [V].
        gaussians: [N]; None to give them later, to `show`.
        port: where it is taken, the next free one is used; 0 is any free one.
        host: the address to listen at; 0.0.0.0 lets other machines in.

    Raises:
        InputError: viser is not installed; views or Gaussians with batch dimensions.
    """

    def __init__(
        self,
        views: Views,
        gaussians: Gaussians | None = None,
        port: int = 8080,
        host: str = "127.0.0.1",
    ):
        try:
            import viser
        except ImportError as error:
            raise InputError("The viewer needs viser: pip install 'viser>=1.1'.") from error
        _check_one_scene("views", views.images.shape[:-4])
        if gaussians is not None:
            _check_one_scene("gaussians", gaussians.opacities.shape[:-1])
        self._frame = Frame.of(views.cameras, gaussians)
        masks = None if views.masks is None else views.masks.cpu()
        cameras = self._frame.cameras(views.cameras)
        self._views = Views(cameras, views.images.cpu(), masks=masks)
        self._up = mean_up(cameras)
        self._scene: tuple[Gaussians | None, str] = (None, WAITING)
        self._pages: dict[int, Page] = {}
        self._closed = Event()
        self._server = viser.ViserServer(host=host, port=port, label="asysplat", verbose=False)
        self._add_panel()
        self._add_cameras()
        if gaussians is not None:
            self.show(gaussians)
        self._set_first_camera()
        self._server.on_client_connect(self._open_page)
        self._server.on_client_disconnect(self._close_page)

    @property
    def url(self) -> str:
        """Return the address to open in a browser."""
        host = self._server.get_host()
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self._server.get_port()}"

    def show(self, gaussians: Gaussians, text: str = "") -> None:
        """Show another state of the scene from now on; may be called from any thread.

        The Gaussians are copied, so the caller may go on to change them in place. Nothing waits
        for the pages: each draws the newest scene when it gets to it.

        Args:
            gaussians: [N].
            text: what to write in the panel, in Markdown.

        Raises:
            InputError: Gaussians with batch dimensions.
        """
        _check_one_scene("gaussians", gaussians.opacities.shape[:-1])
        # Kernels run without bounds checks: what they read must not change meanwhile.
        self._scene = (self._frame.gaussians(gaussians), text)
        degree = math.isqrt(gaussians.sh.shape[-2]) - 1
        if degree != self._sh_degree.max:
            self._sh_degree.max = degree
            self._sh_degree.value = degree
        self._change()

    def wait(self) -> None:
        """Block until Ctrl-C, or until the viewer is closed."""
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop the server, after the pictures that are being drawn."""
        if self._closed.is_set():
            return
        self._closed.set()
        pages = list(self._pages.values())
        for page in pages:
            page.leave()
        for page in pages:
            page.join()
        self._server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_panel(self) -> None:
        gui = self._server.gui
        # Its button would let anyone in, through a server of viser's.
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._layer = gui.add_dropdown("Layer", LAYERS)
        self._sh_degree = gui.add_slider("SH degree", 0, 3, 1, 3)
        self._least_opacity = gui.add_slider("Least opacity", 0.0, 1.0, 0.01, 0.0)
        self._size = gui.add_slider("Size", 0.05, 1.0, 0.05, 1.0)
        for handle in (self._layer, self._sh_degree, self._least_opacity, self._size):
            handle.on_update(lambda _: self._change())
        self._cameras_shown = gui.add_checkbox("Cameras", True)
        self._text = gui.add_markdown(WAITING)

    def _add_cameras(self) -> None:
        scene, cameras = self._server.scene, self._views.cameras
        scene.set_up_direction(self._up.numpy())
        parent = scene.add_frame("/cameras", show_axes=False)
        self._length = length = frustum_length(cameras)
        # Who stands in a camera should see the scene, and not the photograph in its frustum.
        self._server.initial_camera.near = 1.5 * length
        for view in range(cameras.num_views):
            fov, aspect = field_of_view(cameras, view)
            frustum = scene.add_camera_frustum(
                f"/cameras/{view}",
                fov=fov,
                aspect=aspect,
                # viser's scale is the cube root of the frustum's volume, not its length.
                scale=length * (aspect * math.tan(fov / 2) ** 2 / 3) ** (1 / 3),
                thickness=1.5,
                thickness_units="screen",
                color=(209, 98, 45),
                image=thumbnail(self._views.images[view]),
                wxyz=quaternion(cameras, view),
                position=cameras.centers[view].numpy(),
            )
            frustum.on_click(self._click)

        @self._cameras_shown.on_update
        def _(_: Any) -> None:
            parent.visible = self._cameras_shown.value

    def _set_first_camera(self) -> None:
        first = self._server.initial_camera
        first.position, first.look_at, first.up, first.fov = self._stand(0)

    def _click(self, event: Any) -> None:
        # The page takes what it does not draw, in front of its near plane, for what was clicked.
        camera, _ = camera_of(event.client.camera, MOST_PIXELS)
        start, ray = (torch.tensor(v).float() for v in (event.ray_origin, event.ray_direction))
        to_near = event.client.camera.near / (ray @ camera.cam_to_world[0, :3, 2])
        view = pointed_at(self._views.cameras, self._length, start, to_near * ray)
        if view is not None:
            self._fly(event.client, view)

    def _fly(self, client: Any, view: int) -> None:
        camera = client.camera
        with client.atomic():
            camera.position, camera.look_at, camera.up_direction, camera.fov = self._stand(view)

    def _stand(self, view: int) -> tuple[ndarray, ndarray, ndarray, float]:
        """Return position, look-at, up and field of view of a browser in an input camera.

        The up is that of the scene, but for the camera's roll.
        """
        cameras = self._views.cameras
        right, _, forward = cameras.cam_to_world[view, :3, :3].unbind(-1)
        position = cameras.centers[view]
        gaussians, _ = self._scene
        distance = 1.0 if gaussians is None else distance_along(gaussians, position, forward)
        up = self._up - (self._up @ right) * right
        vectors = (position, position + distance * forward, up)
        return *(vector.numpy() for vector in vectors), field_of_view(cameras, view)[0]

    # A coroutine runs before the page's next event, so that the page is known when it leaves.
    async def _open_page(self, client: Any) -> None:
        page = Page(lambda pixels: self._draw(client, pixels))
        self._pages[client.client_id] = page
        page.start()

        async def moved(_: Any) -> None:
            page.change()

        client.camera.on_update(moved)

    def _close_page(self, client: Any) -> None:
        page = self._pages[client.client_id]
        page.leave()
        page.join()
        del self._pages[client.client_id]

    def _change(self) -> None:
        for page in list(self._pages.values()):
            page.change()

    def _draw(self, client: Any, pixels: int) -> bool:
        """Send a page what its camera sees, in about so many pixels; return whether in full."""
        try:
            return self._draw_newest(client, pixels)
        except Exception as error:  # nobody waits for this thread: the panel tells
            self._text.content = f"**{type(error).__name__}:** {error}"
            return True

    def _draw_newest(self, client: Any, pixels: int) -> bool:
        start = time.perf_counter()
        gaussians, text = self._scene
        if gaussians is None:
            return True
        look = Look(
            self._layer.value, self._sh_degree.value, self._least_opacity.value, self._size.value
        )
        camera, in_full = camera_of(client.camera, pixels)
        photograph = None
        if look.layer == "error":
            photograph = photograph_at(self._views, camera, IN_ONE_PLACE)
            text = text if photograph is not None else f"{NO_PHOTOGRAPH}\n\n{text}"
        picture = draw(gaussians, camera.to(gaussians.means.device), look, photograph)
        if not self._pages[client.client_id].is_open:
            return True
        client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)
        client.flush()
        took = 1000 * (time.perf_counter() - start)
        told = f"{gaussians.num_gaussians:,} Gaussians, {camera.width} x {camera.height} pixels "
        self._text.content = f"{told}in {took:.0f} ms\n\n{text}"
        return in_full


def _check_one_scene(name: str, batch: tuple[int, ...]) -> None:
    if batch:
        raise InputError(
            f"The viewer's {name} have the batch dimensions {tuple(batch)}: give one scene's."
        )
