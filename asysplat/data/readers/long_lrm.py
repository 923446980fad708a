"""Reader of `opencv_cameras.json`, the format of Long-LRM, and of its list files.

https://github.com/arthurhero/Long-LRM/blob/main/data/dataset.py
"""

from functools import partial
from pathlib import Path
from typing import Any

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers import common
from asysplat.data.readers.colmap import read_model_points
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.files import read_text

CAMERAS = "opencv_cameras.json"


def find_scenes(root: Path) -> list[Path]:
    """Find folders with an `opencv_cameras.json`.

    `root` may also be such a json file, whatever its name, or a text file with the path of one
    json file per line, relative to itself.
    """
    if not root.is_file():
        return common.folders_with(root, CAMERAS)
    if root.suffix == ".txt":
        lines = [line.strip() for line in read_text(root).splitlines() if line.strip()]
        files = [root.parent / line for line in lines]
        return files if all(file.suffix == ".json" for file in files) else []
    return [root] if root.suffix == ".json" and '"w2c"' in read_text(root) else []


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder with an `opencv_cameras.json`, or the json file itself.

    Every entry has `w2c` (world-to-camera, OpenCV axes), `fx fy cx cy` in pixels of an image of
    `w` x `h`, and `file_path`, relative to the json file. Images are in the file's order.
    """
    file = scene if scene.suffix == ".json" else scene / CAMERAS

    def read(index: int, entry: Any) -> PosedImage:
        where = common.frame_label(file, index, entry)
        image = file.parent / entry["file_path"]
        size = image_size(image)
        pose = common.invert_pose(common.check_rigid(entry["w2c"], f"{where}: w2c"))
        fx, fy, cx, cy = (float(entry[name]) for name in ("fx", "fy", "cx", "cy"))
        lens = Lens(round(entry["w"]), round(entry["h"]), fx, fy, cx, cy)
        return PosedImage(image, common.scale_lens(lens, size, where), pose)

    images = bad.read_each(read, enumerate(common.read_frames(file)["frames"]))
    return PosedScene(file.parent.name, images, partial(read_model_points, file.parent, images))
