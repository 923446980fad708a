"""Reader of `cameras.npz`, the format of IDR: DTU's and BlendedMVS's objects with their masks.

<scene>/cameras.npz or cameras_sphere.npz  world_mat_N: 4x4, world to pixels, of image N
<scene>/image/                             images, in sorted order
<scene>/mask/                              masks of the object, in the same order, if there are any

https://github.com/lioryariv/idr/blob/main/DATA_CONVENTION.md
"""

from pathlib import Path

import cv2
import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.common import (
    HALF_A_PIXEL,
    check_map_size,
    check_rigid,
    folders_with,
    images_in,
    scale_lens,
)
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

CAMERAS = ("cameras_sphere.npz", "cameras.npz")


def find_scenes(root: Path) -> list[Path]:
    """Find folders with cameras and `image`."""
    return [scene for scene in folders_with(root, *CAMERAS) if (scene / "image").is_dir()]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder; its world is that of `world_mat`, in DTU millimeters."""
    file = next(scene / name for name in CAMERAS if (scene / name).is_file())
    images, masks = images_in(scene / "image"), images_in(scene / "mask")
    if masks and len(masks) != len(images):
        raise InputError(
            f"{scene} has {len(images)} images and {len(masks)} masks: give one for each, or none."
        )
    with np.load(file) as cameras:
        matrices = [cameras[f"world_mat_{index}"] for index in range(len(images))]

    def read(index: int, image: Path) -> PosedImage:
        where, size = f"{file}, world_mat_{index} ({image.name})", image_size(image)
        projection = matrices[index][:3]
        projection *= np.sign(np.linalg.det(projection[:, :3]))  # its scale is arbitrary
        matrix, rotation, center, *_ = cv2.decomposeProjectionMatrix(projection)
        matrix /= matrix[2, 2]
        matrix[:2, 2] += HALF_A_PIXEL
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, center[:3, 0] / center[3, 0]
        lens = Lens(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        return PosedImage(
            file=image,
            lens=scale_lens(lens, size, where),
            cam_to_world=check_rigid(pose, where),
            mask=check_map_size(masks[index], size, where) if masks else None,
        )

    return PosedScene(scene.name, bad.read_each(read, enumerate(images)))
