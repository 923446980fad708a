"""The photographs of one scene, as input and held-out views."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data.background import Background, color_name, find_background, read_color
from asysplat.data.bad_images import Policy
from asysplat.data.cameras import CameraOptions, find_missing, refine_given
from asysplat.data.check.matches import find_matches
from asysplat.data.check.report import Verdict, diagnose_cameras
from asysplat.data.normalize import Normalization, normalize
from asysplat.data.readers import open_scene
from asysplat.data.selection import evenly_spaced
from asysplat.data.sequence import FileSequence, MasksOf, Points, PosedScene, SceneOptions
from asysplat.errors import InputError
from asysplat.ranges import AtLeastTwo, Count, check_options
from asysplat.scene import Cameras, Views

MATCHED_SIDE = 400  # pixels of the shorter side, to check the cameras
ANY_SIZE = 8  # pixels a side: bad images are decoded at it, before the size is known
BYTES_PER_PIXEL = 8  # of a reconstruction: RGB, the same at half the size, maps, copies of some
MEASURING = 300  # photographs that take as much as the rendering and the metrics of one
RANGES = {
    "height": Count,
    "width": Count | None,
    "views": AtLeastTwo | None,
    "held_out_every": AtLeastTwo | None,
    "max_held_out": Count,
    "masks": MasksOf,
}
GIVEN = CameraOptions()


@dataclass(frozen=True)
class Photographs:
    """Views of one scene, and its sparse points if any, in the network's frame."""

    name: str  # name of the scene
    inputs: Views  # images as files store them, uint8
    held_out: Views | None  # images in [0, 1]
    input_files: list[str]
    held_out_files: list[str]
    normalization: Normalization  # from the world of the files to the network's frame
    points: Float[Tensor, "P 3"] | None
    background: Float[Tensor, "3"]  # RGB behind the Gaussians
    total: int = 0  # photographs of the scene
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # offset subtracted by `near_origin`
    is_split: bool = False  # whether the data set itself says which images are held out

    @property
    def cameras(self) -> Cameras:
        """The cameras of the inputs and then of the held-out views."""
        inputs, held_out = self.inputs.cameras, self.held_out
        return inputs if held_out is None else inputs.join(held_out.cameras)

    def to(self, device: torch.device) -> "Photographs":
        """Return the photographs with views and points on a device."""
        return replace(
            self,
            inputs=self.inputs.to(device),
            held_out=None if self.held_out is None else self.held_out.to(device),
            background=self.background.to(device),
            points=None if self.points is None else self.points.to(device),
        )

    def all_views(self) -> Views:
        """Return the inputs and the held-out views as one."""
        return self.inputs if self.held_out is None else self.inputs.join(self.held_out)


def open_photographs(
    path: str | Path,
    height: int,
    width: int | None = None,
    views: int | None = 32,
    held_out_every: int | None = 8,
    max_held_out: int = 12,
    layout: str = "auto",
    on_error: Policy = "fail",
    masks: MasksOf = "auto",
    background: Background = "auto",
    cameras: CameraOptions = GIVEN,
    max_gb: float | int = math.inf,
    say: Callable[[str], None] = print,
) -> Photographs:
    """Open photographs, select some evenly, and bring them into the network's frame.

    Args:
        path, layout, on_error: see `open_scene`.
        height, width: size of the views in pixels; width None keeps the first photograph's aspect
            ratio.
        views, max_held_out: number of input and of held-out views, at most; views None: all.
        cameras: choice of given, refined or found cameras.
        held_out_every: hold out every n-th photograph, from the first on, or those that the data
            set holds out, if it names some; None: none.
        masks: whether masks are of an "object", or of what to "ignore"; "auto": see `with_masks`;
            "find": without masks of an object, a network finds it, see `load_object_finder`.
        background: color behind an object; see `with_background`.
        max_gb: memory that the input views may take in a reconstruction; more are left out.
        say: takes warnings: a smaller height than asked for, views that are left out, or cameras
            that do not fit the images.

    Raises:
        InputError: fewer than two input views, or memory for no more; see `open_scene`.

    Example:
        >>> from asysplat import open_photographs
        >>> photographs = open_photographs("my_scene", height=64, views=4, held_out_every=3)
        >>> photographs.inputs.num_views
        4
        >>> len(photographs.held_out_files)
        4
    """
    options = (height, width, views, held_out_every, max_held_out, masks)
    check_options(dict(zip(RANGES, options, strict=True)), RANGES)
    find_object = None
    if masks == "find":
        from asysplat.data.find_masks import load_object_finder

        find_object = load_object_finder()
    if found := find_missing(path, layout, on_error, cameras):
        say(f"cameras: found, see {found}")
        path, layout = found, "auto"
    scene = open_scene(path, SceneOptions(ANY_SIZE, ANY_SIZE, layout, on_error, masks)).scene
    if any(scene.origin):
        say(f"the scene is far from the origin: its new origin is {scene.origin} of the files.")
    lens = scene.images[0].lens
    if width is None:
        if height > lens.height:
            say(f"height={height}: the photographs have {lens.height} pixels, which are used.")
            height = lens.height
        width = max(1, round(height * lens.width / lens.height))
    indices, published = range(len(scene.images)), scene.held_out
    held_out = published or indices[::held_out_every] if held_out_every else []
    rest = sorted(set(indices) - set(held_out) - set(published))
    if len(rest) < 2:
        raise InputError(
            f"{path} has {len(scene.images)} photographs, of which held_out_every={held_out_every} "
            f"leaves {len(rest)}: set held_out_every=null, or give more photographs."
        )
    count, one_gb = min(views or len(rest), len(rest)), height * width * BYTES_PER_PIXEL / 1e9
    room = max_gb / one_gb - MEASURING
    if room < 2:
        raise InputError(
            f"memory_gb leaves {max(0, max_gb):.2g} GB for photographs, of which two of "
            f"{height}x{width} pixels take {(2 + MEASURING) * one_gb:.2g}: give more, or lower "
            "height= or refinement.max_gaussians=."
        )
    if count > room:
        say(f"{int(room)} of {count} photographs are used: memory_gb= holds no more.")
        count = int(room)
    inputs = evenly_spaced(rest, count)
    held_out = evenly_spaced(held_out, min(max_held_out, len(held_out))) if held_out else []
    if not found:
        scene = _with_chosen_cameras(scene, sorted((*inputs, *held_out)), cameras, say)
    return load_photographs(scene, inputs, held_out, height, width, background, find_object, say)


def load_photographs(
    scene: PosedScene,
    inputs: list[int],
    held_out: list[int],
    height: int,
    width: int,
    background: Background = "auto",
    find_object: Callable[[Views], Views] | None = None,
    say: Callable[[str], None] = print,
) -> Photographs:
    """Read the photographs of a scene at these indices, and bring them into the network's frame.

    `held_out` may be empty; the other options are those of `open_photographs`.
    """
    sequence = FileSequence(scene, SceneOptions(height, width))
    chosen = inputs, held_out or inputs[:1]
    both = [sequence.stored(each).validate(scene.name) for each in chosen]
    if find_object is not None and not _transparent_share(both[0]):
        both = [find_object(views) for views in both]
    input_views, targets, normalization = normalize(*both)
    input_views, targets, color = with_background(input_views, targets, background, say)
    files = [str(image.file) for image in scene.images]
    return Photographs(
        name=scene.name,
        inputs=input_views,
        held_out=targets.decoded() if held_out else None,
        input_files=[files[index] for index in inputs],
        held_out_files=[files[index] for index in held_out],
        normalization=normalization,
        background=color,
        points=normalized_points(scene.points, normalization),
        total=len(scene.images),
        origin=scene.origin,
        is_split=bool(scene.held_out),
    )


def with_background(
    inputs: Views, targets: Views, background: Background, say: Callable[[str], None]
) -> tuple[Views, Views, Float[Tensor, "3"]]:
    """Choose the color behind the Gaussians; transparent pixels of the views show it.

    With "auto" it is white where photographs are transparent, else the color that all borders show,
    else, and with "mean", the mean color of the inputs. Where borders show one color, the inputs
    have alphas afterwards.
    """
    white = torch.ones(3)
    color = None if background in ("auto", "mean") else read_color(background)
    if share := _transparent_share(inputs):
        if color is None:
            color = white if background == "auto" else inputs.mean_color()
        name = color_name(color)
        say(f"object: {share:.0%} of the pixels are {name} behind it (masks=, background=)")
        return inputs.over(white, color), targets.over(white, color), color
    inputs, targets = (replace(views, alphas=None) for views in (inputs, targets))
    if background == "auto":
        found = find_background(inputs.images)
        if found is not None:
            color, alphas = found
            share = 1 - alphas.mean().item()
            name = color_name(color)
            say(f"object: {share:.0%} of the pixels are {name} around it (background=)")
            if inputs.masks is not None:
                alphas = alphas.where(inputs.masks, 1)
            inputs = replace(inputs, alphas=alphas)
    return inputs, targets, inputs.mean_color() if color is None else color


def _transparent_share(views: Views) -> float:
    return 0.0 if views.alphas is None else (views.alphas < 0.5).float().mean().item()


def _with_chosen_cameras(
    scene: PosedScene, selected: list[int], cameras: CameraOptions, say: Callable[[str], None]
) -> PosedScene:
    """Return a scene whose selected photographs have the chosen cameras; warn of wrong ones."""
    if cameras.choice == "checked" and _diagnose(scene).fits:
        say("cameras: as given (cameras=); they fit the points that some photographs share")
        return scene
    part = replace(scene, images=[scene.images[index] for index in selected])
    part, agree = refine_given(part, cameras, say)
    images = dict(enumerate(scene.images)) | dict(zip(selected, part.images, strict=True))
    scene = replace(part, images=list(images.values()))
    if agree:
        return scene
    verdict = _diagnose(scene)
    if not verdict.fits and verdict.fit is not None:  # else too few points match to tell
        say(
            f"warning: {verdict.summary}; asysplat check shows it at full size. "
            "The reconstruction goes on."
        )
    return scene


def _diagnose(scene: PosedScene) -> Verdict:
    """Compare cameras with points that photographs share.

    All photographs may be matched: neighbors among the inputs may be too far apart.
    """
    lens = scene.images[0].lens
    scale = min(1.0, MATCHED_SIDE / min(lens.height, lens.width))
    height, width = (max(1, round(scale * side)) for side in (lens.height, lens.width))
    matched = FileSequence(scene, SceneOptions(height, width))
    files = [str(image.file) for image in scene.images]
    return diagnose_cameras(matched.cameras, find_matches(matched), files)


def normalized_points(
    points: Points | None, normalization: Normalization
) -> Float[Tensor, "P 3"] | None:
    """Move sparse points of a scene's files to the network's frame; None if there are none."""
    if points is None or not len(points):
        return None
    pose, world = normalization.world_to_mean, torch.as_tensor(points, dtype=torch.float64)
    return ((world @ pose[:3, :3].mT + pose[:3, 3]) * normalization.scale).float()
