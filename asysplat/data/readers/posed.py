"""Reader of images with `K.txt` and `poses.txt`, the format of deep-video-mvs.

https://github.com/ardaduz/deep-video-mvs/tree/master/sample-data
"""

from functools import partial
from pathlib import Path

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.colmap import read_model_points
from asysplat.data.readers.common import (
    MILLIMETERS,
    check_map_size,
    check_rigid,
    folders_with,
    images_in,
    scale_lens,
)
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

POSES = ("poses_refined.txt", "poses.txt")  # the first file that exists is read


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `K.txt` and poses."""
    folders = folders_with(root, "K.txt")
    return [folder for folder in folders if any((folder / name).is_file() for name in POSES)]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder with `K.txt`, `poses.txt`, `images/` and, optionally, `depth/`.

    `K.txt` is the 3x3 pinhole matrix for the images as they are. Line i of `poses.txt`, or of
    `poses_refined.txt` if there is one, belongs to the i-th image in sorted order: camera-to-world
    4x4, row-major, OpenCV axes, meters. Depth maps have the images' names, as one-channel PNG of
    millimeters along z, 0 where unknown.
    """
    file = next((scene / name for name in POSES if (scene / name).is_file()), scene / POSES[-1])
    poses, images = np.loadtxt(file, ndmin=2), images_in(scene / "images")
    (fx, _, cx), (_, fy, cy), _ = np.loadtxt(scene / "K.txt").tolist()
    depths = scene / "depth"
    if len(poses) != len(images):
        raise InputError(
            f"{file} has {len(poses)} poses and {scene / 'images'} {len(images)} images: "
            "give one line per image."
        )

    def read(index: int, image: Path) -> PosedImage:
        pose = check_rigid(poses[index].reshape(4, 4), f"{file}, pose {index} ({image.name})")
        size, where = image_size(image), str(image)
        lens, depth = scale_lens(Lens(*size, fx, fy, cx, cy), size, where), None
        if depths.is_dir():
            depth = check_map_size(depths / f"{image.stem}.png", size, where)
        return PosedImage(
            file=image,
            lens=lens,
            cam_to_world=pose,
            depth=depth,
            depth_unit=MILLIMETERS,
        )

    posed = bad.read_each(read, enumerate(images))
    return PosedScene(scene.name, posed, partial(read_model_points, scene, posed))
