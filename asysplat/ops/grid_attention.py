"""Attention among the tokens of all views at the same place in a p_g x p_g grid (Sec. 3.3)."""

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.kernels.dispatch import check_device, check_float, check_shape, look_up_backend


def grid_attention(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
    backend: str = "auto",
) -> Float[Tensor, "B V h w H P"]:
    """Attend from token (i, j) of each view to the tokens (i + a p_g, j + b p_g) of all views.

    Here a and b are any integers for which the token exists.

    Args:
        q, k, v: queries, keys and values of the h x w tokens of V views; P is the head_dim.
        grid: p_g, the side of the grid in tokens; 1 is full attention.
        backend: "sdpa" (torch's fused attention), "reference", or "auto", which is "sdpa".
    """
    sdpa, reference = grid_attention_sdpa, grid_attention_reference
    backends = {"auto": sdpa, "sdpa": sdpa, "reference": reference}
    implementation = look_up_backend("grid_attention", backends, backend)
    _check(q, k, v, grid)
    return implementation(q, k, v, grid)


def _check(q: Tensor, k: Tensor, v: Tensor, grid: int) -> None:
    if grid < 1:
        raise InputError(f"grid_attention got grid={grid}: give 1, full attention, or more.")
    if q.ndim != 6:
        check_shape("grid_attention", "q", q, "[B, V, h, w, H, P]")
    for name, tensor in {"q": q, "k": k, "v": v}.items():
        check_shape("grid_attention", name, tensor, tuple(q.shape))
        check_float("grid_attention", name, tensor)
        check_device("grid_attention", name, tensor, "q", q)


def grid_attention_reference(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
) -> Float[Tensor, "B V h w H P"]:
    """Attend by one softmax over all tokens, masked to those at the same place in the grid."""
    views, height, width = q.shape[1:4]
    rows = torch.arange(height, device=q.device)[:, None] % grid
    columns = torch.arange(width, device=q.device) % grid
    group = (rows * grid + columns).flatten().repeat(views)
    queries, keys, values = (tensor.flatten(1, 3) for tensor in (q, k, v))
    scores = torch.einsum("bthp,bshp->bhts", queries, keys) / q.shape[-1] ** 0.5
    scores = scores.masked_fill(group[:, None] != group, -torch.inf)
    output = torch.einsum("bhts,bshp->bthp", scores.softmax(-1), values)
    return output.view_as(q)


def grid_attention_sdpa(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
) -> Float[Tensor, "B V h w H P"]:
    """Attend by torch's fused attention, with a batch entry for each place in the grid."""
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
