"""Depth maps and masks that lie beside a photograph."""

from pathlib import Path

from asysplat.data.images import image_size
from asysplat.errors import InputError


def beside(path: Path, size: tuple[int, int], where: str) -> Path:
    """`path`, an image of any size that shows the whole photograph.

    Args:
        size: width and height of the photograph.
        where: the file, frame and field, for the message.

    Raises:
        InputError: it is missing, damaged or of other proportions.
    """
    found = image_size(path)
    if not same_proportions(found, size):
        raise InputError(
            f"{where}: {path} is {found[0]} x {found[1]} and the image {size[0]} x {size[1]}: "
            "give one with the image's proportions."
        )
    return path


def same_proportions(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether both (width, height) can show the same, to a pixel of `one`."""
    return abs(one[0] * other[1] / other[0] - one[1]) <= 1
