"""A synthetic scene on disk."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from rich.progress import track

from asysplat.data import ProceduralScene
from asysplat.data.readers.common import opencv_from_opengl

RENDERED = (135, 240)  # height, width; enlarged to that of the photographs
PICTURES = 8  # that are different to look at
QUALITY = 90  # of the JPEG


def write_photographs(folder: Path, frames: int, height: int, width: int) -> Path:
    """Write a transforms.json and `frames` JPEG files of different bytes; return the folder."""
    scene = ProceduralScene(seed=0, height=RENDERED[0], width=RENDERED[1], num_frames=frames)
    shown = scene.views([number * frames // PICTURES for number in range(PICTURES)]).images
    pictures = [_enlarged(image.permute(1, 2, 0).numpy(), height, width) for image in shown]
    (folder / "images").mkdir(parents=True)
    entries = []
    # The change of axes from OpenGL to OpenCV is its own inverse.
    poses = [opencv_from_opengl(pose) for pose in scene.cameras.cam_to_world.double().numpy()]
    for number in track(range(frames), "photographs", transient=True):
        name = f"images/{number:05d}.jpg"
        # The comment gives each file bytes of its own, by which the cache knows it.
        comment = f"photograph {number}"
        pictures[number % PICTURES].save(folder / name, quality=QUALITY, comment=comment)
        entries.append({"file_path": name, "transform_matrix": poses[number].tolist()})
    focal = float(scene.cameras.intrinsics[0, 0, 0]) * width / RENDERED[1]
    content = {"w": width, "h": height, "fl_x": focal, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def _enlarged(image: np.ndarray, height: int, width: int) -> Image.Image:
    """Enlarge an image, and add grain as photographs have it: flat areas would decode too soon."""
    levels = Image.fromarray((image * 255).astype(np.uint8)).resize((width, height))
    grain = np.random.default_rng(0).normal(0, 4, (height, width, 1))
    return Image.fromarray((np.asarray(levels) + grain).clip(0, 255).astype(np.uint8))
