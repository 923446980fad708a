"""transforms_train.json with one field of view, and train/ of transparent images without suffix."""

import json
import math

import numpy as np
from PIL import Image

from layouts import AXES, pinholes, poses

HAS_DEPTHS = False
FREE_INTRINSICS = False


def write(views, folder, split="train", alphas=None):
    (folder / split).mkdir(parents=True)
    frames = []
    for index, pose in enumerate(poses(views)):
        name = f"./{split}/r_{index}"
        pixels = (views.images[index] * 255).round().byte().permute(1, 2, 0).numpy()
        alpha = np.ones(pixels.shape[:2]) if alphas is None else alphas[index].numpy()
        alpha = (255 * alpha).astype(np.uint8)
        Image.fromarray(np.dstack((pixels, alpha))).save(folder / f"{name}.png")
        frames.append({"file_path": name, "transform_matrix": (pose @ AXES).tolist()})
    angle = 2 * math.atan(views.cameras.width / 2 / pinholes(views)[0][0])
    content = {"camera_angle_x": angle, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder
