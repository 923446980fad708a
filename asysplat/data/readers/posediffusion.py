"""Reader of `gt_cameras.npz`, PoseDiffusion's cameras of CO3D's photographs.

<scene>/gt_cameras.npz  of each image gtR, gtT and gtFL, see `read_scene`
<scene>/                images, in sorted order; or in images/

https://github.com/facebookresearch/PoseDiffusion
"""

from pathlib import Path

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.common import (
    check_rigid,
    folders_with,
    images_in,
    invert_pose,
    scale_lens,
)
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

CAMERAS = "gt_cameras.npz"
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])  # OpenCV's from PyTorch3D's: x left, y up, z forward


def find_scenes(root: Path) -> list[Path]:
    """Find folders with `gt_cameras.npz`."""
    return folders_with(root, CAMERAS)


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder, with cameras as PyTorch3D has them.

    A point x of the world, a row, is at x gtR + gtT before the camera; gtFL has the focal lengths
    in halves of the image's shorter side; the principal point is in the middle.
    """
    file, images = scene / CAMERAS, images_in(scene) or images_in(scene / "images")
    with np.load(file) as cameras:
        rotations, translations, focals = (cameras[name] for name in ("gtR", "gtT", "gtFL"))
    if len(images) != len(rotations):
        raise InputError(
            f"{file} has {len(rotations)} cameras for {len(images)} images: give one for each."
        )

    def read(index: int, image: Path) -> PosedImage:
        where, size = f"{file}, camera {index} ({image.name})", image_size(image)
        fx, fy = (focals[index] * min(size) / 2).tolist()
        lens = scale_lens(Lens(*size, fx, fy, size[0] / 2, size[1] / 2), size, where)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations[index].T, translations[index]
        return PosedImage(image, lens, invert_pose(AXES @ check_rigid(pose, where)))

    return PosedScene(scene.name, bad.read_each(read, enumerate(images)))
