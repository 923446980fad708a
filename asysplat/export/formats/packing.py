"""What formats share: errors of reading, an order in space, packed rotations, and axes."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from asysplat.errors import InputError, brief
from asysplat.geometry.spherical_harmonics import sh_basis
from asysplat.scene import Gaussians

MORTON_BITS = 21  # of each coordinate; three fit into 64
TINY = torch.finfo(torch.float32).tiny  # replaces scales and opacities that round to 0
GENERIC_DIRECTION = (0.36, 0.48, 0.8)  # no SH function up to degree 3 is 0 along it


def morton_order(means: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
    """Compute an order in space along a Z-order curve, in which bytes compress to less."""
    low = means.double().amin(0)
    extent = (means.double().amax(0) - low).amax().clamp_min(1e-300)
    cells = ((means.double() - low) / extent * (2**MORTON_BITS - 1)).long()
    # Two zero bits are inserted after each bit: halves of the number move apart until bits do.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | cells << shift) & mask
    return (cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2).argsort(stable=True)


def in_morton_order(gaussians: Gaussians) -> Gaussians:
    order = morton_order(gaussians.means)
    return gaussians.map(lambda field: field[order])


def split_largest(quats: Float[Tensor, "N 4"]) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Split rotations into the index of the largest component, made positive, and the other three.

    These are in [-1/sqrt(2), 1/sqrt(2)].
    """
    quats = torch.nn.functional.normalize(quats.double(), dim=-1)
    largest = quats.abs().argmax(-1)
    value = quats.gather(1, largest[:, None])
    others = torch.arange(3, device=quats.device) + (torch.arange(3) >= largest[:, None])
    return largest, quats.gather(1, others) * torch.where(value < 0, -1.0, 1.0)


def join_largest(largest: Int[ndarray, "N"], rest: Float[ndarray, "N 3"]) -> Float[Tensor, "N 4"]:
    """Compute unit quaternions from the index of the largest component and the other three."""
    value = np.sqrt(np.maximum(0, 1 - np.square(rest).sum(1)))
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    quats = np.empty((len(rest), 4))
    np.put_along_axis(quats, others, rest, 1)
    np.put_along_axis(quats, largest[:, None], value[:, None], 1)
    return torch.nn.functional.normalize(torch.from_numpy(quats), dim=-1)


def half_turn(gaussians: Gaussians, axis: int) -> Gaussians:
    """Turn a scene by 180 degrees around an axis, without rounding.

    OpenCV's axes become OpenGL's, right, up, backward (around x), or glTF's, left, up, forward (z).
    """
    signs = -torch.ones(3, dtype=torch.float64)
    signs[axis] = 1
    direction = torch.tensor(GENERIC_DIRECTION, dtype=torch.float64)
    count = gaussians.sh.shape[-2]
    sh_signs = (sh_basis(signs * direction, count) / sh_basis(direction, count)).round()
    return Gaussians(
        means=gaussians.means * signs.to(gaussians.means),
        quats=gaussians.quats * torch.cat((torch.ones(1), signs)).to(gaussians.quats),
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        sh=gaussians.sh * sh_signs[:, None].to(gaussians.sh),
    )


@contextmanager
def reading(path: str | Path, kind: str) -> Generator[Path]:
    """Yield the path of a file; errors inside become a sentence that begins with it."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is not a file: name an existing one.")
    try:
        yield path
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except MemoryError:  # a large file, not a damaged one
        raise
    except Exception as error:  # a file that is cut short makes its reader raise anything
        reason = f"{path} cannot be read as {kind} ({brief(error)})"
        raise InputError(f"{reason}: it is cut short or of another format.") from error


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
