"""Image files of a scene: which there are, and the lens for an image of another size."""

import math
from dataclasses import replace
from pathlib import Path

from asysplat.data.images import Lens
from asysplat.data.readers.beside import same_proportions
from asysplat.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg")


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder, sorted; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def scaled(lens: Lens, size: tuple[int, int], where: str) -> Lens:
    """The lens over an image of another size that shows the same.

    Args:
        size: width and height of the image.
        where: the file and frame, for the message.

    Raises:
        InputError: intrinsics that no camera has, or an image of other proportions.
    """
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not (min(lens.fx, lens.fy) > 0 and all(map(math.isfinite, numbers))):
        raise InputError(
            f"{where} has intrinsics {', '.join(f'{number:g}' for number in numbers)}: "
            "give finite numbers, and focal lengths > 0 in pixels."
        )
    stated = (lens.width, lens.height)
    # To a pixel of the smaller one, which was rounded.
    if min(stated) < 1 or not same_proportions(*sorted((size, stated))):
        raise InputError(
            f"{where} is {size[0]} x {size[1]} and its intrinsics are for {stated[0]} x "
            f"{stated[1]}: give images with those proportions, or the images' own intrinsics."
        )
    x, y = size[0] / stated[0], size[1] / stated[1]
    return replace(
        lens,
        width=size[0],
        height=size[1],
        fx=lens.fx * x,
        fy=lens.fy * y,
        cx=lens.cx * x,
        cy=lens.cy * y,
    )
