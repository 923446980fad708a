"""Gaussians as .splat, 32 bytes each, of antimatter15's viewer and many phone apps."""

from pathlib import Path

import numpy as np
import torch

from asysplat.errors import InputError
from asysplat.export.formats.packing import TINY, prepare_for_export, reading
from asysplat.files import atomic_write
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.scene import Gaussians

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read_splat(path: str | Path) -> Gaussians:
    """Read a .splat file: N Gaussians with SH of degree 0, colors and rotations of 8 bits.

    Scales are stored as they are, alpha is the opacity, rotations are (v - 128) / 128, wxyz.
    Format: https://github.com/antimatter15/splat
    """
    with reading(path, ".splat") as file:
        rows = np.frombuffer(file.read_bytes(), ROW)
        if not len(rows) or not (rows["quat"] != 128).any(1).all():
            raise InputError("no Gaussian, or one with a rotation of 0: write it again.")
        rgba = torch.from_numpy(rows["rgba"] / np.float32(255))
        return Gaussians(
            means=torch.tensor(rows["mean"]),
            quats=(torch.tensor(rows["quat"], dtype=torch.float32) - 128) / 128,
            scales=torch.tensor(rows["scale"]).clamp_min(TINY),
            opacities=rgba[:, 3].clamp_min(TINY),
            sh=(rgba[:, None, :3] - 0.5) / SH_C0,
        ).validate()


def write_splat(path: str | Path, gaussians: Gaussians) -> None:
    """Write one scene, without batch dimension, as a .splat file, without SH above degree 0."""
    scene = prepare_for_export(gaussians)
    # The most visible first, as viewers show a file while it loads.
    order = (scene.opacities.log() + scene.scales.log().sum(1)).argsort(descending=True)
    scene = scene.map(lambda field: field[order])
    colors = torch.cat((0.5 + SH_C0 * scene.sh[:, 0], scene.opacities[:, None]), 1)
    quats = torch.nn.functional.normalize(scene.quats.double(), dim=-1)
    rows = np.zeros(scene.num_gaussians, ROW)
    rows["mean"], rows["scale"] = scene.means.numpy(), scene.scales.numpy()
    rows["rgba"] = (255 * colors.double()).round().clamp(0, 255).numpy()
    rows["quat"] = (128 * quats + 128).round().clamp(0, 255).numpy()
    with atomic_write(path) as partial:
        rows.tofile(partial)
