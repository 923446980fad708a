"""Reader of `opencv_cameras.json`, the format of Long-LRM, and of its list files.

https://github.com/arthurhero/Long-LRM/blob/main/data/dataset.py
"""

from functools import partial
from pathlib import Path
from typing import Any

from asysplat.data.bad_images import BadFrames
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.colmap import points_beside
from asysplat.data.readers.common import folders_with, inverted, rigid, scaled
from asysplat.data.readers.transforms import read_frames
from asysplat.data.sequence import Photograph, PosedScene
from asysplat.errors import InputError

CAMERAS = "opencv_cameras.json"


def find_scenes(root: Path) -> list[Path]:
    """Find folders with an `opencv_cameras.json`.

    `root` may also be such a json file, whatever its name, or a text file that names json files,
    one a line, relative to itself.
    """
    if not root.is_file():
        return folders_with(root, CAMERAS)
    if root.suffix == ".txt":
        lines = [line.strip() for line in _text(root).splitlines() if line.strip()]
        listed = [root.parent / line for line in lines]
        return listed if all(file.suffix == ".json" for file in listed) else []
    return [root] if root.suffix == ".json" and '"w2c"' in _text(root) else []


def read_scene(scene: Path, bad: BadFrames) -> PosedScene:
    """Read a folder with an `opencv_cameras.json`, or the json file itself.

    Every frame has `w2c` (world-to-camera, OpenCV axes), `fx fy cx cy` in pixels of an image of
    `w` x `h`, and `file_path`, relative to the json file. Frames are in the file's order.

    Raises:
        InputError: a file that cannot be used, or intrinsics for images of other proportions.
    """
    file = scene if scene.suffix == ".json" else scene / CAMERAS
    photographs = []
    for index, frame in enumerate(read_frames(file)["frames"]):
        with bad.caught():
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
                raise InputError(f"{file}, frame {index} has no file_path: name its image.")
            where = f"{file}, frame {index} ({frame['file_path']})"
            photographs.append(_photograph(frame, file.parent / frame["file_path"], where))
    read_points = partial(points_beside, file.parent, photographs)
    return PosedScene(file.parent.name, photographs, read_points)


def _photograph(frame: dict[str, Any], image: Path, where: str) -> Photograph:
    size = image_size(image)
    return Photograph(
        image=image,
        lens=scaled(_lens(frame, where), size, where),
        cam_to_world=inverted(rigid(frame.get("w2c"), f"{where}: w2c")),
    )


def _lens(frame: dict[str, Any], where: str) -> Lens:
    try:
        width, height = (round(frame[name]) for name in ("w", "h"))
        return Lens(width, height, *(float(frame[name]) for name in ("fx", "fy", "cx", "cy")))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where} needs the numbers w, h, fx, fy, cx and cy in pixels: one is missing or is "
            f"none ({error!r})."
        ) from error


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8-sig", errors="replace")
