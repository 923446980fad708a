"""Grid attention with each grid place as a batch entry of torch's fused attention."""

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor


def grid_attention_sdpa(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
) -> Float[Tensor, "B V h w H P"]:
    """See `asysplat.ops.grid_attention`."""
    sizes = {"gh": grid, "gw": grid, "v": q.shape[1], "h": q.shape[2] // grid}
    q, k, v = (
        rearrange(tensor, "b v (h gh) (w gw) H p -> (b gh gw) H (v h w) p", gh=grid, gw=grid)
        for tensor in (q, k, v)
    )
    output = F.scaled_dot_product_attention(q, k, v)
    return rearrange(output, "(b gh gw) H (v h w) p -> b v (h gh) (w gw) H p", **sizes)
