"""Reader of `poses_bounds.npy`, the format of LLFF.

https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap
"""

from functools import partial
from pathlib import Path

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.colmap import read_model_points
from asysplat.data.readers.common import check_rigid, folders_with, images_in, scale_lens
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

POSES = "poses_bounds.npy"
FOLDERS = ("images", "images_2", "images_4", "images_8")  # the largest images first
COLUMNS = 17  # a 3x5 matrix, the nearest and the farthest depth


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `poses_bounds.npy`."""
    return folders_with(root, POSES)


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder with a `poses_bounds.npy` and images.

    Row i of the array belongs to the i-th image in sorted order: a row-major 3x5 matrix, whose
    first four columns are camera-to-world with axes down, right, backward and whose fifth is
    height, width and focal length of the full-size image, then the nearest and farthest depth. The
    principal point is the center. Images are taken from the first of `images`, `images_2`,
    `images_4` and `images_8` that holds one image per row.
    """
    file = scene / POSES
    rows = np.load(file, allow_pickle=False)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS:
        raise InputError(
            f"{file} holds {rows.shape}: expected a row of {COLUMNS} numbers per image."
        )
    files = {name: images_in(scene / name) for name in FOLDERS}
    fitting = next((images for images in files.values() if len(images) == len(rows)), None)
    if fitting is None:
        counts = ", ".join(f"{len(images)} in {name}/" for name, images in files.items() if images)
        raise InputError(
            f"{file} has {len(rows)} rows, but the images there are {counts or 'none'}: "
            f"give one image per row, in one of {', '.join(FOLDERS)}."
        )

    def read(index: int, image: Path) -> PosedImage:
        where, size = f"{file}, row {index} ({image.name})", image_size(image)
        down, right, backward, center, (height, width, focal) = rows[index, :15].reshape(3, 5).T
        lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2)
        pose = np.eye(4)
        pose[:3] = np.stack((right, down, -backward, center), axis=-1)
        return PosedImage(image, scale_lens(lens, size, where), check_rigid(pose, where))

    images = bad.read_each(read, enumerate(fitting))
    return PosedScene(scene.name, images, partial(read_model_points, scene, images))
