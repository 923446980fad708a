"""Reader of `NAME_par.txt`, the format of Middlebury's multi-view stereo: temple and dino.

The first line is the number of images; the others are NAME, then K and R, each row by row, and t:
K (R x + t) is the pixel of a point x, with the first pixel's center at 0.

https://vision.middlebury.edu/mview/data/
"""

from pathlib import Path

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.common import HALF_A_PIXEL, check_rigid, invert_pose, scale_lens
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.files import read_text


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `NAME_par.txt`, `root` or in it."""
    folders = [root, *sorted(root.iterdir())] if root.is_dir() else []
    found = [folder for folder in folders if folder.is_dir() and any(folder.glob("*_par.txt"))]
    return found[:1] if root in found else found


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder; images are in the file's order, beside it."""
    file = min(scene.glob("*_par.txt"))
    count, *lines = read_text(file).strip().splitlines() or ["0"]
    if len(lines) != int(count):
        raise InputError(f"{file} has {len(lines)} lines for {count} images: copy it again.")

    def read(line: str) -> PosedImage:
        name, *numbers = line.split()
        values, image = np.array(numbers, np.float64), scene / name
        (fx, _, cx), (_, fy, cy), _ = values[:9].reshape(3, 3).tolist()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = values[9:18].reshape(3, 3), values[18:]
        where, size = f"{file}, {name}", image_size(image)
        lens = Lens(*size, fx, fy, cx + HALF_A_PIXEL, cy + HALF_A_PIXEL)
        pose = invert_pose(check_rigid(pose, where))
        return PosedImage(image, scale_lens(lens, size, where), pose)

    return PosedScene(scene.name, bad.read_each(read, ((line,) for line in lines)))
