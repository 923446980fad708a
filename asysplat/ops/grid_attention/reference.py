"""Grid attention as one softmax over all tokens, masked to those at the same place in the grid."""

import torch
from jaxtyping import Float
from torch import Tensor


def grid_attention_reference(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
) -> Float[Tensor, "B V h w H P"]:
    """Attend by a masked softmax; see `asysplat.ops.grid_attention`."""
    views, height, width = q.shape[1:4]
    rows = torch.arange(height, device=q.device)[:, None] % grid
    columns = torch.arange(width, device=q.device) % grid
    group = (rows * grid + columns).flatten().repeat(views)
    queries, keys, values = (tensor.flatten(1, 3) for tensor in (q, k, v))
    scores = torch.einsum("bthp,bshp->bhts", queries, keys) / q.shape[-1] ** 0.5
    scores = scores.masked_fill(group[:, None] != group, -torch.inf)
    output = torch.einsum("bhts,bshp->bthp", scores.softmax(-1), values)
    return output.view_as(q)
