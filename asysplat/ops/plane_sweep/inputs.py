"""The inputs of the cost volume's kernels: the views of all scenes, one after the other."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

VECTOR = 16  # planes that the CPU kernel computes at once: LANES, which needs Numba


class CostInputs(NamedTuple):
    """Tensors, or NumPy arrays of the same shapes; n counts the views of all scenes.

    Args:
        images: [n, H, W], minus the mean of each.
        padded: the same, [n, H + 1, W + 1]: the last row and column twice.
        neighbors: [n, K], counted as n is; -1 for none.
        projections: [n, K, 3, 4].
        inverse: [n, planes rounded up to whole vectors], inverse depths.
    """

    images: Tensor
    padded: Tensor
    neighbors: Tensor
    projections: Tensor
    inverse: Tensor


def prepare(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> CostInputs:
    """Return the inputs of the kernels from those of `reference.cost_volume`."""
    device = images.device
    # Without its mean, an image's small variances are not lost beside large squares.
    flat = (images - images.mean((-1, -2), keepdim=True)).flatten(0, 1)
    first = torch.arange(len(images), device=device)[:, None, None] * images.shape[1]
    steps = (ranges[..., 1:] - ranges[..., :1]) / (planes - 1)
    places = torch.arange(-(-planes // VECTOR) * VECTOR, device=device)
    return CostInputs(
        images=flat.contiguous(),
        padded=F.pad(flat[:, None], (0, 1, 0, 1), mode="replicate")[:, 0].contiguous(),
        neighbors=torch.where(neighbors >= 0, neighbors + first, -1).flatten(0, 1).contiguous(),
        projections=projections.flatten(0, 1).contiguous(),
        inverse=(ranges[..., :1] + places * steps).flatten(0, 1),
    )
