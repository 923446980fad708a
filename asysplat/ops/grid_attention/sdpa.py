"""Grid attention by torch's fused attention, with a batch entry for each place in the grid."""

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Bool, Float
from torch import Tensor


def grid_attention_sdpa(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
) -> Float[Tensor, "B V h w H P"]:
    """Attend by torch's fused attention; see `asysplat.ops.grid_attention`."""
    views, height, width = q.shape[1:4]
    below, right = -height % grid, -width % grid
    mask = None
    if below or right:
        q, k, v = (F.pad(t, (0, 0, 0, 0, 0, right, 0, below)) for t in (q, k, v))
        mask = _mask_padding(height, width, grid, q)
    sizes = {"gh": grid, "gw": grid, "v": views, "h": q.shape[2] // grid}
    q, k, v = (
        rearrange(tensor, "b v (h gh) (w gw) H p -> (b gh gw) H (v h w) p", gh=grid, gw=grid)
        for tensor in (q, k, v)
    )
    output = F.scaled_dot_product_attention(q, k, v, mask)
    output = rearrange(output, "(b gh gw) H (v h w) p -> b v (h gh) (w gw) H p", **sizes)
    return output[:, :, :height, :width]


def _mask_padding(
    height: int, width: int, grid: int, padded: Float[Tensor, "B V h w H P"]
) -> Bool[Tensor, "place 1 1 key"]:
    """Return the mask of the keys at each place that are not padding.

    Where all of them are padding it is True, as a softmax over no key is NaN.
    """
    batch, views, rows, columns = padded.shape[:4]
    real = torch.zeros(rows, columns, dtype=torch.bool, device=padded.device)
    real[:height, :width] = True
    real = repeat(
        real, "(h gh) (w gw) -> (b gh gw) 1 1 (v h w)", gh=grid, gw=grid, b=batch, v=views
    )
    return real | ~real.any(-1, keepdim=True)
