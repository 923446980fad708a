"""Writers of the layouts on disk, one module each.

write(views, folder) -> what a user would give as data.root

A module says what its layout cannot hold: HAS_DEPTHS = False, or FREE_INTRINSICS = False where
there is one focal length and the principal point is the center.
"""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

MILLIMETERS = 1000  # a scene unit


def save_image(path: Path, image: torch.Tensor) -> None:
    """[3, H, W] in [0, 1] as PNG, whatever the name ends with."""
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = (image * 255).round().byte().permute(1, 2, 0)
    Image.fromarray(levels.numpy()).save(path, format="png")


def save_depth(path: Path, depth: torch.Tensor, steps: float = MILLIMETERS) -> None:
    """[H, W] as 16-bit PNG of `steps` a scene unit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = (depth.double() * steps).round().numpy().astype(np.uint16)
    Image.fromarray(stored).save(path)


def pinholes(views) -> list[tuple[float, float, float, float]]:
    """fx, fy, cx, cy of every view."""
    return [(k[0][0], k[1][1], k[0][2], k[1][2]) for k in views.cameras.intrinsics.tolist()]


def poses(views) -> np.ndarray:
    """Camera-to-world, [V, 4, 4] float64."""
    return views.cameras.cam_to_world.double().numpy()
