"""Reader of NeRF's synthetic scenes, made with Blender: objects before a transparent background.

<scene>/transforms_train.json  the images that are fitted
<scene>/transforms_test.json   those that are held out, where there are any
<scene>/{train,test}/          r_N.png, RGBA; other files there are maps of the same views

https://github.com/bmild/nerf (load_blender.py)
"""

from dataclasses import replace
from pathlib import Path

from asysplat.data.bad_images import BadImages
from asysplat.data.readers.common import folders_with, read_frames
from asysplat.data.readers.transforms import read_images
from asysplat.data.sequence import PosedScene

TRAIN, TEST = "transforms_train.json", "transforms_test.json"


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `transforms_train.json`."""
    return folders_with(root, TRAIN)


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read the images that train, then those that test; the ones that validate are left out."""
    images = read_images(read_frames(scene / TRAIN), scene / TRAIN, bad)
    if (scene / TEST).exists():
        tests = read_images(read_frames(scene / TEST), scene / TEST, bad)
        images += [replace(image, held_out=True) for image in tests]
    return PosedScene(scene.name, images)
