"""Draw test views of several systems side by side, with an enlarged crop: the paper's Figure 4."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import torch.nn.functional as F
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from asysplat.data.images import image_size
from asysplat.data.readers.common import images_in
from asysplat.errors import InputError, list_names
from asysplat.evaluation.metrics import psnr
from asysplat.evaluation.view_images import NEAREST_INPUT, TARGET, read_images
from paper.style import OURS, STYLE

MAX_SCENES = 4  # where none are chosen
ENLARGED = 4  # how often a crop fits into each side
WIDTH = 2  # inches of a column
TRUTH = "ground truth"

Image = Float[Tensor, "3 H W"]


class ComparedView(NamedTuple):
    """A test view, as inputs, systems and the ground truth show it."""

    scene: str
    images: Mapping[str, Image]  # by title; the nearest input first, the ground truth last


class Crop(NamedTuple):
    """A part of an image, in pixels."""

    top: int
    left: int
    height: int
    width: int


def read_views(
    folders: Sequence[Path], scenes: Sequence[str] = (), views: Sequence[str] = ()
) -> list[ComparedView]:
    """Read test views from folders of images; the first also has what they are compared with.

    Args:
        folders: their names are the titles of the columns.
        scenes: none: the first `MAX_SCENES`.
        views: names of photographs without suffix, in every scene; none: the first view.
    """
    first, titles = folders[0], [folder.name for folder in folders]
    if twice := {title for title in titles if titles.count(title) > 1}:
        raise InputError(
            f"images= has several folders named {list_names(twice)}: rename all but one, since the "
            "columns have their names."
        )
    if not scenes:
        scenes = sorted(path.parent.name for path in first.glob(f"*/{TARGET}"))[:MAX_SCENES]
    if not scenes:
        raise InputError(
            f"images={first} has no scene with a folder {TARGET}: begin with a folder that "
            "evaluate.py write_images=FOLDER wrote."
        )
    compared = []
    for scene in scenes:
        places = {"nearest input": first / scene / NEAREST_INPUT}
        places |= {folder.name: folder / scene for folder in folders}
        places[TRUTH] = first / scene / TARGET
        names = views or [path.stem for path in images_in(places[TRUTH])[:1]]
        for name in names:
            files = {title: _find(place, name) for title, place in places.items()}
            width, height = image_size(files[TRUTH])
            images = {
                title: read_images([file], height, width).images[0] for title, file in files.items()
            }
            compared.append(ComparedView(scene, images))
    return compared


def _find(folder: Path, view: str) -> Path:
    """Find the image of a view."""
    files = {path.stem: path for path in images_in(folder)}
    if view not in files:
        raise InputError(
            f"{folder} has no image of view {view}: it has {list_names(files) or 'none'}; choose "
            "of these by scenes= and views=, or add the image."
        )
    return files[view]


def draw_views(views: Sequence[ComparedView]) -> Figure:
    """Draw two rows for each view: its images, and the same crop of each above their PSNR."""
    titles = list(views[0].images)
    aspects = [view.images[TRUTH].shape[1] / view.images[TRUTH].shape[2] for view in views]
    ratios = [aspect for aspect in aspects for _ in range(2)]
    with matplotlib.rc_context(STYLE):
        size = WIDTH * len(titles), WIDTH * sum(ratios) + 0.3 * (len(views) + 1)
        figure = Figure(figsize=size, layout="compressed")
        grid = figure.subplots(2 * len(views), len(titles), height_ratios=ratios)
        for axes, title in zip(grid[0], titles, strict=True):
            axes.set_title(title)
        for view, whole, enlarged in zip(views, grid[::2], grid[1::2], strict=True):
            whole[0].set_ylabel(view.scene)
            _draw_view(view, whole, enlarged)
    return figure


def _draw_view(view: ComparedView, whole: Iterable[Axes], enlarged: Iterable[Axes]) -> None:
    """Draw a view's images with a frame, and what it encloses."""
    truth = view.images[TRUTH]
    top, left, height, width = find_crop(view)
    for image, axes, below in zip(view.images.values(), whole, enlarged, strict=True):
        pixels = image.permute(1, 2, 0).numpy()
        axes.imshow(pixels)
        # The center of the first pixel is at 0.
        frame = Rectangle((left - 0.5, top - 0.5), width, height, fill=False, ec=OURS, lw=1.5)
        axes.add_patch(frame)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        below.imshow(pixels[top : top + height, left : left + width])
        below.set(xticks=[], yticks=[])
        below.spines[:].set(visible=True, color=OURS, linewidth=1.5)
        if image is not truth:
            below.set_xlabel(f"{psnr(image[None], truth[None]).item():.2f} dB")


def find_crop(view: ComparedView) -> Crop:
    """Find the crop in which the squared error of all systems together is largest."""
    _, *systems, truth = view.images.values()
    error = sum((image - truth).double().square().sum(0) for image in systems)
    height, width = (max(1, side // ENLARGED) for side in error.shape)
    # Sums over crops from those over the parts above and left of each pixel.
    sums = F.pad(error.cumsum(0).cumsum(1), (1, 0, 1, 0))
    rows = sums[height:] - sums[:-height]
    crops = rows[:, width:] - rows[:, :-width]
    top, left = divmod(int(crops.argmax()), crops.shape[1])
    return Crop(top, left, height, width)
