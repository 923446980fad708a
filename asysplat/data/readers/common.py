"""Functions that several readers share: folders, frames, intrinsics and poses, each checked.

`size` is always (width, height) of an image, `where` the file and the image, for messages. Whatever
does not pass a check raises an InputError.
"""

import os
import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from asysplat.data.images import HEIF, ImageFile, Lens, image_size, same_proportions
from asysplat.errors import InputError, brief
from asysplat.files import read_json
from asysplat.scene import MAX_FIELD_OF_VIEW, ORTHONORMAL_TOLERANCE

File = TypeVar("File", bound=ImageFile)
DEPTH = 3  # levels below the named folder that are searched; DL3DV has parts and hashes
SUFFIXES = (".png", ".jpg", ".jpeg", *HEIF)
HALF_A_PIXEL = 0.5  # to be added to principal points where the first pixel's center is at 0
MILLIMETERS = 0.001  # meters: the usual unit of stored depths


@contextmanager
def file_errors(path: Path) -> Generator[None]:
    """Raise an InputError for files that lack something, or that the system refuses."""
    try:
        yield
    except InputError:
        raise
    except (OSError, LookupError, TypeError, ValueError, BadZipFile) as error:
        raise InputError(f"{path} cannot be read ({brief(error)}): repair its files.") from error


def folders_with(root: Path, *marks: str, depth: int = DEPTH) -> list[Path]:
    """Find `root` if it has one of the files `marks`, else all folders below it that have one.

    Sorted; folders within a result are not searched.
    """
    if not root.is_dir():
        return []
    if any((root / mark).exists() for mark in marks):
        return [root]
    if depth == 0:
        return []
    with os.scandir(root) as entries:  # faster than Path, which queries each entry again
        folders = sorted(entry.path for entry in entries if entry.is_dir())
    return [
        scene for folder in folders for scene in folders_with(Path(folder), *marks, depth=depth - 1)
    ]


def natural_order(path: Path) -> list[str | int]:
    """Return a sort key by the numbers in the path: 2 before 10."""
    parts = re.split(r"([0-9]+)", path.as_posix())
    return [int(part) if index % 2 else part for index, part in enumerate(parts)]


def read_frames(file: Path) -> dict[str, Any]:
    """Read a JSON object with a list "frames"."""
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file} has no list "frames": give one entry for each image.')
    return content


def frame_label(file: Path, index: int, entry: dict[str, Any]) -> str:
    """Return the name of an entry of "frames" for messages."""
    return f"{file}, frame {index} ({entry['file_path']})"


def images_in(folder: Path) -> list[Path]:
    """List the image files of a folder, sorted; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def scale_lens(lens: Lens, size: tuple[int, int], where: str) -> Lens:
    """Scale a lens to an image of another size and the same field of view."""
    (width, height), lens_size = size, (lens.width, lens.height)
    if not max(lens_size) < MAX_FIELD_OF_VIEW * min(lens.fx, lens.fy):
        raise InputError(
            f"{where} has focal lengths {lens.fx:g} and {lens.fy:g}: expected pixels, at least "
            f"1/{MAX_FIELD_OF_VIEW} of the image's sides."
        )
    # To a pixel of the smaller one, whose size was rounded.
    if min(lens_size) < 1 or not same_proportions(*sorted((size, lens_size))):
        refuse_turned(size, lens_size)
        raise InputError(
            f"{where} is {width} x {height} and its intrinsics are for {lens_size[0]} x "
            f"{lens_size[1]}: give images with those proportions, or the images' own intrinsics."
        )
    x, y = width / lens_size[0], height / lens_size[1]
    focal = {"fx": lens.fx * x, "fy": lens.fy * y, "cx": lens.cx * x, "cy": lens.cy * y}
    return replace(lens, width=width, height=height, **focal)


def refuse_turned(size: tuple[int, int], lens_size: tuple[int | float, int | float]) -> None:
    """Check that an image is not stored turned against intrinsics for `lens_size`."""
    if lens_size == size[::-1] and lens_size != size:
        raise InputError(
            f"photographs are stored as {size[0]} x {size[1]}, with an orientation tag, and their "
            f"intrinsics are for {lens_size[0]} x {lens_size[1]}: save them upright (magick "
            "mogrify -auto-orient), or have their cameras found with cameras=found."
        )


def check_map_size(path: File, size: tuple[int, int], where: str) -> File:
    """Return the path of a depth map or mask, after checking that it shows the whole image."""
    width, height = image_size(path)
    if not same_proportions((width, height), size):
        raise InputError(
            f"{where}: {path} is {width} x {height} and the image {size[0]} x {size[1]}: "
            "give one with the image's proportions."
        )
    return path


def check_rigid(stored: object, where: str) -> Float[ndarray, "4 4"]:
    """Check a rigid transform, 4 rows of 4 numbers, and make its rotation exactly orthonormal."""
    matrix = np.array(stored, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{where} is not 4x4 or holds NaN: repair it, or leave its image out.")
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


def invert_pose(pose: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Invert a rigid matrix; the result is exactly rigid."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result
