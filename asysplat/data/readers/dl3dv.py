"""Reader of DL3DV-10K: nerfstudio's transforms.json with smaller images than it names.

root/<1K..11K>/<hash>/{transforms.json, images_4/}   DL3DV-ALL-960P (480P has images_8, 2K images_2)
root/<hash>/nerfstudio/{transforms.json, images_4/}  DL3DV-Benchmark

https://github.com/DL3DV-10K/Dataset
https://huggingface.co/datasets/DL3DV/DL3DV-Benchmark
"""

import re
from pathlib import Path

from asysplat.data.bad_images import BadImages
from asysplat.data.readers.common import folders_with, read_frames
from asysplat.data.readers.transforms import read_images
from asysplat.data.sequence import PosedScene
from asysplat.errors import InputError

TRANSFORMS = "transforms.json"
BENCHMARK = "nerfstudio"  # the folder in a benchmark scene
IMAGES = ("images_4", "images_8", "images_2")  # 960P first, as the paper uses


def find_scenes(root: Path) -> list[Path]:
    """Find folders of scenes: named by a hash, or with downsized images but no `images`.

    Scenes that users made with nerfstudio have a folder `images`.
    """
    folders = folders_with(root, TRANSFORMS, f"{BENCHMARK}/{TRANSFORMS}")
    scenes = []
    for folder in folders:
        content, names = _content(folder), (folder.name, folder.parent.name)
        hashed = any(re.fullmatch("[0-9a-f]{64}", name) for name in names)
        if (hashed or not (content / "images").is_dir()) and _images(content) is not None:
            scenes.append(folder)
    return scenes


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a scene's folder, or the `nerfstudio` in it: at 960P, else at the available size.

    The intrinsics are for the video's size (w x h in the file) and are scaled to the images'.
    """
    folder = _content(scene)
    images = _images(folder)
    if images is None:
        raise InputError(
            f"{folder} has no folder {', '.join(IMAGES)}: unpack the scene's archive there."
        )
    file = folder / TRANSFORMS
    content = read_frames(file)
    # The images lie in `images`, whatever folder the file names.
    frames = [
        {**entry, "file_path": f"{images}/{Path(entry['file_path']).name}"}
        for entry in content["frames"]
    ]
    posed = read_images({**content, "frames": frames}, file, bad, resized=True)
    return PosedScene(scene.parent.name if scene.name == BENCHMARK else scene.name, posed)


def _content(scene: Path) -> Path:
    inner = scene / BENCHMARK
    return inner if (inner / TRANSFORMS).is_file() else scene


def _images(folder: Path) -> str | None:
    return next((name for name in IMAGES if (folder / name).is_dir()), None)
