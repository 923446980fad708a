"""Reader of Replica as published with NICE-SLAM: images, depths and a trajectory of each room.

root/cam_params.json           intrinsics, image size, and depth steps per meter (6553.5)
root/<scene>/traj.txt          row i: 16 numbers, camera-to-world of image i, row-major, OpenCV axes
root/<scene>/results/          frame000000.jpg, depth000000.png (16 bits, along z)

https://github.com/cvg/nice-slam (scripts/download_replica.sh, src/utils/datasets.py)
"""

from pathlib import Path

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.common import (
    HALF_A_PIXEL,
    check_map_size,
    check_rigid,
    folders_with,
    scale_lens,
)
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.files import read_json, read_text

TRAJECTORY = "traj.txt"
PARAMETERS = "cam_params.json"


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `traj.txt` and `results`."""
    return [folder for folder in folders_with(root, TRAJECTORY) if (folder / "results").is_dir()]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a room's folder.

    `cam_params.json` lies above it, or in it if there is one room alone. Every row of `traj.txt`
    must have its image, and, if there is any depth map, its depth map.
    """
    files = (scene / PARAMETERS, scene.parent / PARAMETERS)
    parameters = next((file for file in files if file.is_file()), None)
    if parameters is None:
        raise InputError(f"{files[1]} does not exist: copy it there from Replica.zip.")
    camera = read_json(parameters)["camera"]
    fx, fy, cx, cy = (float(camera[name]) for name in ("fx", "fy", "cx", "cy"))
    lens = Lens(camera["w"], camera["h"], fx, fy, cx + HALF_A_PIXEL, cy + HALF_A_PIXEL)
    trajectory, results = scene / TRAJECTORY, scene / "results"
    rows = read_text(trajectory).strip().splitlines()
    count = len(list(results.glob("frame*.jpg")))
    if count > len(rows):
        raise InputError(f"{trajectory} has {len(rows)} rows for {count} images: copy it again.")
    has_depths = next(results.glob("depth*.png"), None) is not None

    def read(index: int, row: str) -> PosedImage:
        image, depth = results / f"frame{index:06d}.jpg", results / f"depth{index:06d}.png"
        size = image_size(image)
        if size != (lens.width, lens.height):
            raise InputError(
                f"{image} is {size[0]} x {size[1]}, but {parameters} is for {lens.width} x "
                f"{lens.height}: give intrinsics for the images' own resolution."
            )
        pose = np.array(row.split(), np.float64).reshape(4, 4)
        return PosedImage(
            file=image,
            lens=scale_lens(lens, size, str(image)),
            cam_to_world=check_rigid(pose, f"{trajectory}, row {index + 1}"),
            depth=check_map_size(depth, size, str(image)) if has_depths else None,
            depth_unit=1 / camera["scale"],
        )

    return PosedScene(scene.name, bad.read_each(read, enumerate(rows)))
