"""Reader of photographs with `K.txt` and `poses.txt`, the format of deep-video-mvs.

https://github.com/ardaduz/deep-video-mvs/tree/master/sample-data
"""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from asysplat.data.bad_images import BadFrames
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.colmap import points_beside
from asysplat.data.readers.common import MILLIMETERS, beside, folders_with, images_in, rigid, scaled
from asysplat.data.sequence import Photograph, PosedScene
from asysplat.errors import InputError

POSES = ("poses_refined.txt", "poses.txt")  # the first that is there is read


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `K.txt`."""
    return folders_with(root, "K.txt")


def read_scene(scene: Path, bad: BadFrames) -> PosedScene:
    """Read a folder with `K.txt`, `poses.txt`, `images/` and, perhaps, `depth/`.

    `K.txt` is the 3x3 pinhole matrix for the images as they are. Line i of `poses.txt` belongs to
    the i-th image in sorted order: camera-to-world 4x4, row-major, OpenCV axes, meters;
    `poses_refined.txt` is taken in its place where there is one. Depth maps have the images' names,
    as one-channel PNG of millimeters along z, 0 where unknown.

    Raises:
        InputError: text that cannot be used, or not one pose an image.
    """
    file = next((scene / name for name in POSES if (scene / name).is_file()), scene / POSES[-1])
    poses, images = _read_numbers(file, 16), images_in(scene / "images")
    matrix = _read_matrix(scene / "K.txt")
    if len(poses) != len(images):
        raise InputError(
            f"{file} has {len(poses)} poses and {scene / 'images'} {len(images)} images: "
            "give one line an image."
        )
    photographs = []
    for index, (image, pose) in enumerate(zip(images, poses, strict=True)):
        with bad.caught():
            where = f"{file}, pose {index} ({image.name})"
            photographs.append(_photograph(image, matrix, rigid(pose.reshape(4, 4), where)))
    return PosedScene(scene.name, photographs, partial(points_beside, scene, photographs))


def _photograph(
    image: Path, matrix: Float[ndarray, "3 3"], cam_to_world: Float[ndarray, "4 4"]
) -> Photograph:
    size = image_size(image)
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    depths = image.parents[1] / "depth"
    depth = depths / f"{image.stem}.png"
    return Photograph(
        image=image,
        lens=scaled(Lens(*size, fx, fy, cx, cy), size, str(image)),
        cam_to_world=cam_to_world,
        depth=beside(depth, size, str(image)) if depths.is_dir() else None,
        depth_unit=MILLIMETERS,
    )


def _read_matrix(file: Path) -> Float[ndarray, "3 3"]:
    matrix = _read_numbers(file, 3)
    zeros = matrix[[0, 1, 2, 2], [1, 0, 0, 1]] if len(matrix) == 3 else matrix
    if len(matrix) != 3 or zeros.any() or matrix[2, 2] != 1:
        raise InputError(
            f"{file} holds {matrix.tolist()}: expected the pinhole matrix "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels."
        )
    return matrix


def _read_numbers(file: Path, columns: int) -> Float[ndarray, "rows columns"]:
    try:
        lines = [line.split() for line in file.read_text(encoding="utf-8").splitlines()]
        rows = [[float(number) for number in line] for line in lines if line]
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as numbers ({error}): write it again.") from error
    for index, row in enumerate(rows):
        if len(row) != columns:
            raise InputError(
                f"{file}, row {index} holds {len(row)} numbers: expected {columns}: write the file "
                "again, it may be cut short."
            )
    return np.array(rows, dtype=np.float64).reshape(-1, columns)
