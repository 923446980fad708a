"""What several readers need: folders, JSON, images, lenses and poses, each checked."""

import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from asysplat.data.images import Lens, image_size, same_proportions
from asysplat.errors import InputError
from asysplat.scene import ORTHONORMAL_TOLERANCE

DEPTH = 3  # levels below the named folder that are searched; DL3DV has parts and hashes
SUFFIXES = (".png", ".jpg", ".jpeg")
MILLIMETERS = 0.001  # meters: the usual unit of stored depths


def folders_with(root: Path, *marks: str, depth: int = DEPTH) -> list[Path]:
    """Find `root`, if one of the files `marks` lies there, else all such folders below it.

    Sorted. Folders within a folder that was found are not searched.
    """
    if not root.is_dir():
        return []
    if any((root / mark).exists() for mark in marks):
        return [root]
    if depth == 0:
        return []
    with os.scandir(root) as entries:  # faster than Path, which asks again for each entry
        folders = sorted(entry.path for entry in entries if entry.is_dir())
    return [
        scene for folder in folders for scene in folders_with(Path(folder), *marks, depth=depth - 1)
    ]


def natural_order(path: Path) -> list[str | int]:
    """Return a sort key by the numbers in the path: 2 before 10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if part.isdecimal() else part for part in parts]


def read_json(file: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: the file is missing, empty or not JSON.
    """
    if not file.is_file():
        raise InputError(f"{file} does not exist: put it there, or name another file.")
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if not text.strip():
        raise InputError(f"{file} is empty: write it again.")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{file} is not JSON ({error}): repair or write it again.") from error


def number(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return the number under `key`, or `default` where there is none.

    Args:
        where: the file and frame, for the message.

    Raises:
        InputError: it is not a finite number.
    """
    value = settings.get(key, default)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}: give a finite number.")
    return float(value)


def images_in(folder: Path) -> list[Path]:
    """List the image files of a folder, sorted; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def scaled(lens: Lens, size: tuple[int, int], where: str) -> Lens:
    """Scale a lens to an image of another size that shows the same.

    Args:
        size: width and height of the image.
        where: the file and frame, for the message.

    Raises:
        InputError: intrinsics that are not finite or focal lengths <= 0, or an image of other
            proportions.
    """
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not (min(lens.fx, lens.fy) > 0 and all(map(math.isfinite, numbers))):
        raise InputError(
            f"{where} has intrinsics {', '.join(f'{number:g}' for number in numbers)}: "
            "give finite numbers, and focal lengths > 0 in pixels."
        )
    stated = (lens.width, lens.height)
    # To a pixel of the smaller one, whose size was rounded.
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


def beside(path: Path, size: tuple[int, int], where: str) -> Path:
    """Check a depth map or mask: an image of any size that shows the whole photograph.

    Args:
        size: width and height of the photograph.
        where: the file, frame and field, for the message.

    Returns:
        path

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


def rigid(stored: Any, where: str) -> Float[ndarray, "4 4"]:
    """Check a rigid transform, and make its rotation exactly orthonormal.

    Args:
        stored: 4 rows of 4 numbers, or an array.
        where: the file, frame and field, for the message.

    Raises:
        InputError: it is not a rotation and a translation.
    """
    try:
        matrix = np.array(stored, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise InputError(f"{where} is not 4x4: give four rows of four numbers.")
    if not np.isfinite(matrix).all():
        raise InputError(f"{where} holds NaN or infinity: drop this frame or repair its pose.")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > ORTHONORMAL_TOLERANCE:
        raise InputError(f"{where} has last row {matrix[3].tolist()}: it must be 0 0 0 1.")
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where} is not a rotation (R Rᵀ is {error:.2g} from the identity, the determinant is "
            f"{np.linalg.det(rotation):.3g}): remove scale, shear and mirroring from it."
        )
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right
    matrix[3] = (0, 0, 0, 1)
    return matrix


def opencv_from_opengl(cam_to_world: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Convert camera-to-world from OpenGL axes (y up, z backward) to OpenCV's."""
    return cam_to_world * (1, -1, -1, 1)


def inverted(pose: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Invert a rigid matrix; the result is exactly rigid."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result
