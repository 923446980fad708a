"""Attention over the tokens of all views with one place in a p_g x p_g grid (paper, Sec. 3.3)."""

from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.dispatch import pick_backend
from asysplat.ops.grid_attention.reference import grid_attention_reference
from asysplat.ops.grid_attention.sdpa import grid_attention_sdpa

_BACKENDS = {
    "auto": grid_attention_sdpa,
    "sdpa": grid_attention_sdpa,
    "reference": grid_attention_reference,
}


def grid_attention(
    q: Float[Tensor, "B V h w H P"],
    k: Float[Tensor, "B V h w H P"],
    v: Float[Tensor, "B V h w H P"],
    grid: int,
    backend: str = "auto",
) -> Float[Tensor, "B V h w H P"]:
    """Token (i, j) of every view attends to the tokens (i + a p_g, j + b p_g) of all views.

    Args:
        q, k, v: token maps of V views, H heads of width P.
        grid: p_g; 1 is full attention.

    Raises:
        InputError: a token map whose sides are not multiples of `grid`, or an unknown backend.
    """
    form = pick_backend("grid_attention", _BACKENDS, backend)
    height, width = q.shape[2:4]
    if height % grid or width % grid:
        raise InputError(
            f"grid_attention got a token map of {height}x{width}: both sides must be multiples "
            f"of the grid, {grid}; change the resolution or the patch size."
        )
    return form(q, k, v, grid)
