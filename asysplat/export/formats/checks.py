"""Checks of files that are read and of scenes that are written, for all formats."""

from pathlib import Path

import torch

from asysplat.errors import InputError
from asysplat.scene import Gaussians

TINY = torch.finfo(torch.float32).tiny  # replaces scales and opacities that round to 0


def require_file(path: str | Path) -> Path:
    """Check that a file exists and return its path; raise InputError if there is none."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is not a file: name an existing one.")
    return path


def prepare_for_export(gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Convert one scene to `dtype`, on the CPU and without gradients."""
    if gaussians.opacities.ndim != 1:
        raise InputError(
            f"Gaussians.opacities has shape {tuple(gaussians.opacities.shape)}: expected [N]; "
            "write the scenes of a batch one by one."
        )
    if gaussians.num_gaussians == 0:
        raise InputError("Gaussians has no Gaussians: give at least one to write.")
    return gaussians.map(torch.Tensor.detach).to("cpu", dtype).validate()
