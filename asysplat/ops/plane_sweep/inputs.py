"""The inputs of the cost volume's kernels: the views of all scenes in one dimension."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

VECTOR = 16  # planes that the CPU kernel computes at once: its LANES, whose import needs Numba


class CostInputs(NamedTuple):
    """Tensors, or NumPy arrays of the same shapes, for the n views of all scenes.

    Args:
        images: [n, H, W] images, each minus its mean.
        padded: [n, H + 1, W + 1] images with the last row and column repeated.
        neighbors: [n, K] indices of neighboring views among all n; -1 for none.
        projections: [n, K, 3, 4], see `reference.cost_volume`.
        inverse: [n, planes rounded up to whole vectors] inverse depths.
    """

    images: Tensor
    padded: Tensor
    neighbors: Tensor
    projections: Tensor
    inverse: Tensor


def prepare_inputs(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> CostInputs:
    """Convert the inputs of `reference.cost_volume` to those of the kernels."""
    device = images.device
    # The mean's square would hide the small variances of an image.
    flat = (images - images.mean((-1, -2), keepdim=True)).flatten(0, 1)
    first = torch.arange(len(images), device=device)[:, None, None] * images.shape[1]
    steps = (ranges[..., 1:] - ranges[..., :1]) / (planes - 1)
    indices = torch.arange(-(-planes // VECTOR) * VECTOR, device=device)
    return CostInputs(
        images=flat.contiguous(),
        padded=F.pad(flat[:, None], (0, 1, 0, 1), mode="replicate")[:, 0].contiguous(),
        neighbors=torch.where(neighbors >= 0, neighbors + first, -1).flatten(0, 1).contiguous(),
        projections=projections.flatten(0, 1).contiguous(),
        inverse=(ranges[..., :1] + indices * steps).flatten(0, 1),
    )
