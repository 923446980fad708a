"""Read the images that a system rendered of the test views, in place of a scene; write ours."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.data.images import load_image
from asysplat.data.readers.common import images_in
from asysplat.data.sequence import FileSequence
from asysplat.data.sources import Task
from asysplat.data.write import write_image
from asysplat.errors import InputError, list_names
from asysplat.evaluation.metrics import nearest_view_images
from asysplat.files import make_folder
from asysplat.rendering import Rendering
from asysplat.scene import Cameras, Views

# Folders of a scene's folder: what its renderings are compared with.
TARGET, NEAREST_INPUT = "target", "nearest_input"


@dataclass(frozen=True)
class ViewImages:
    """The rendered images of a scene's test views."""

    images: Float[Tensor, "V 3 H W"]

    def render(
        self,
        cameras: Cameras,
        background: Float[Tensor, "3"],
        masks: Bool[Tensor, "V H W"] | None = None,
    ) -> Rendering:
        """Return the images as a rendering without depths; `cameras` are those of the test."""
        return Rendering(self.images, torch.ones_like(self.images[:, 0]), None, stats={})


def find_images(folder: Path, tasks: Sequence[Task]) -> dict[str, list[Path]]:
    """Find the image of every test view of every scene, by the scene's name.

    `folder` has a folder for each scene, named as the scene, with an image for each test view,
    named as the view's photograph or by its number (`view_names`); other images are ignored.
    """
    option, names = f"images={folder}", {task.sequence.name for task in tasks}
    if not folder.is_dir():
        raise InputError(f"{option} is no folder: name one that has a folder for each scene.")
    folders = {path.name for path in folder.iterdir() if path.is_dir()}
    if further := folders - names:
        raise InputError(
            f"{option} has {list_names(further)}, named as no scene of the data: rename or remove; "
            f"the scenes are {list_names(names)}."
        )
    if missing := names - folders:
        raise InputError(
            f"{option} has no folder of {len(missing)} of the {len(names)} scenes, "
            f"{list_names(missing)}: add them, or leave these scenes out of the data."
        )
    return {
        task.sequence.name: find_view_files(folder / task.sequence.name, view_names(task))
        for task in tasks
    }


def read_images(paths: Sequence[Path], height: int, width: int) -> ViewImages:
    """Read images of `height` x `width` pixels."""
    images = []
    for path in paths:
        pixels = torch.tensor(load_image(path))
        if tuple(pixels.shape[:2]) != (height, width):
            size = "x".join(map(str, pixels.shape[:2]))
            raise InputError(
                f"{path} is {size} (height x width), and the test views are {height}x{width}: "
                "render at that size, or set data.height and data.width."
            )
        images.append(pixels.permute(2, 0, 1).float() / 255)
    return ViewImages(torch.stack(images))


def write_images(
    folder: Path, names: Sequence[str], rendered: Tensor, inputs: Views, targets: Views
) -> None:
    """Write a scene's renderings as `find_images` finds them, with targets and nearest inputs.

    Args:
        folder: the scene's.
        names: names of the test views, see `view_names`.
        rendered: [V, 3, H, W].
    """
    written = {
        folder: rendered,
        folder / TARGET: targets.images,
        folder / NEAREST_INPUT: nearest_view_images(inputs, targets),
    }
    for place, images in written.items():
        make_folder(place, "write_images")
        for name, image in zip(names, images.cpu(), strict=True):
            write_image(image, place / f"{name}.png")


def view_names(task: Task) -> list[str]:
    """Return the names of a task's test views: their photographs', or else five-digit numbers."""
    sequence, targets = task.sequence, task.selection.targets
    if not isinstance(sequence, FileSequence):
        return [f"{index:05d}" for index in targets]
    names = [PurePosixPath(str(image.file)).stem for image in sequence.scene.images]
    counts = Counter(names)
    if twice := {names[index] for index in targets if counts[names[index]] > 1}:
        raise InputError(
            f"{sequence.name} has several photographs named {list_names(twice)}, in different "
            "folders: rename them, so that their renderings can be told apart."
        )
    return [names[index] for index in targets]


def find_view_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """Find the image of each test view of a scene, in a folder, by the views' names."""
    files: dict[str, list[Path]] = {}
    for path in images_in(folder):
        files.setdefault(path.stem, []).append(path)
    if missing := {name for name in names if name not in files}:
        raise InputError(
            f"{folder} has no image of {len(missing)} of the {len(names)} test views, "
            f"{list_names(missing)}: add one for each, named as the view's photograph."
        )
    if twice := {name for name in names if len(files[name]) > 1}:
        raise InputError(
            f"{folder} has several images named {list_names(twice)}: remove all but one."
        )
    return [files[name][0] for name in names]
