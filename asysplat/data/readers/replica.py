"""Reader of Replica as published with NICE-SLAM: images, depths and a trajectory of each room.

root/cam_params.json           intrinsics, image size, and depth steps per meter (6553.5)
root/<scene>/traj.txt          row i: 16 numbers, camera-to-world of image i, row-major, OpenCV axes
root/<scene>/results/          frame000000.jpg, depth000000.png (16 bits, along z)

https://github.com/cvg/nice-slam (scripts/download_replica.sh, src/utils/datasets.py)
"""

from pathlib import Path

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.common import (
    check_map_size,
    check_rigid,
    folders_with,
    number,
    scale_lens,
)
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.files import read_json, read_text

TRAJECTORY = "traj.txt"
PARAMETERS = "cam_params.json"
MIN_SCALE = 1e-9  # depth steps per meter
HALF_A_PIXEL = 0.5  # cx is 599.5 of 1200: these files put the first pixel's center at 0


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
    content = read_json(parameters)
    camera = content.get("camera") if isinstance(content, dict) else None
    if not isinstance(camera, dict):
        raise InputError(f'{parameters} has no "camera": copy it again from Replica.zip.')
    names = ("w", "h", "fx", "fy", "cx", "cy", "scale")
    width, height, fx, fy, cx, cy, scale = (number(camera, n, str(parameters)) for n in names)
    if min(width, height, fx, fy) <= 0 or scale < MIN_SCALE:
        raise InputError(
            f"{parameters}: w, h, fx and fy of its camera must be above 0, and scale at least "
            f"{MIN_SCALE:g}."
        )
    lens = Lens(round(width), round(height), fx, fy, cx + HALF_A_PIXEL, cy + HALF_A_PIXEL)
    trajectory, results = scene / TRAJECTORY, scene / "results"
    if not trajectory.is_file():
        raise InputError(f"{trajectory} does not exist: name a room's folder.")
    rows = read_text(trajectory).strip().splitlines()
    count = len(list(results.glob("frame*.jpg")))
    if count > len(rows):
        raise InputError(
            f"{trajectory} has {len(rows)} rows for {count} images: give a row of 16 numbers "
            "for each, or copy the file again."
        )
    has_depths = next(results.glob("depth*.png"), None) is not None

    def read(index: int, row: str) -> PosedImage:
        image, depth = results / f"frame{index:06d}.jpg", results / f"depth{index:06d}.png"
        size = image_size(image)
        if size != (lens.width, lens.height):
            raise InputError(
                f"{image} is {size[0]} x {size[1]}, but {parameters} is for {lens.width} x "
                f"{lens.height}: give intrinsics for the images' own resolution."
            )
        numbers = row.split()
        pose = [numbers[start : start + 4] for start in range(0, len(numbers), 4)]
        return PosedImage(
            file=image,
            lens=scale_lens(lens, size, str(image)),
            cam_to_world=check_rigid(pose, f"{trajectory}, row {index + 1}"),
            depth=check_map_size(depth, size, str(image)) if has_depths else None,
            depth_unit=1 / scale,
        )

    return PosedScene(scene.name, bad.read_each(read, enumerate(rows)))
