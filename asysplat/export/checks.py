"""What every format asks of a file that is read, and of a scene that is written."""

from pathlib import Path

import torch

from asysplat.errors import InputError
from asysplat.scene import Gaussians

TINY = torch.finfo(torch.float32).tiny  # in place of a scale or opacity that rounds to 0


def existing(path: str | Path) -> Path:
    """Return the path of a file that is there.

    Raises:
        InputError: there is none.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is no file: name one that is there.")
    return path


def as_written(gaussians: Gaussians) -> Gaussians:
    """Return one scene in float32, on the CPU and without gradients.

    Raises:
        InputError: a batch dimension, no Gaussians, or what `Gaussians.validate` refuses.
    """
    if gaussians.opacities.ndim != 1:
        raise InputError(
            f"Gaussians.opacities has shape {tuple(gaussians.opacities.shape)}: expected [N], so "
            "write the scenes of a batch one by one."
        )
    if gaussians.num_gaussians == 0:
        raise InputError("Gaussians has no Gaussians: give at least one to write.")
    return gaussians.map(torch.Tensor.detach).to("cpu", torch.float32).validate()


def as_read(path: Path, gaussians: Gaussians) -> Gaussians:
    """Return a scene that was read from `path`.

    Raises:
        InputError: a batch dimension, no Gaussians, or what `Gaussians.validate` refuses.
    """
    if gaussians.opacities.ndim != 1 or gaussians.num_gaussians == 0:
        shape = tuple(gaussians.opacities.shape)
        raise InputError(
            f"{path} has opacities of shape {shape}: expected [N], one Gaussian or more."
        )
    return gaussians.validate(f"{path}: Gaussians")
