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
    """Let token (i, j) of every view attend to tokens (i + a p_g, j + b p_g) of all views.

    Args:
        q, k, v: token maps of V views and H heads, P the head_dim.
        grid: p_g; 1 is full attention.

    Raises:
        InputError: shapes, devices or types that do not go together, grid < 1, or an unknown
            backend.
    """
    form = pick_backend("grid_attention", _BACKENDS, backend)
    _check(q, k, v, grid)
    return form(q, k, v, grid)


def _check(q: Tensor, k: Tensor, v: Tensor, grid: int) -> None:
    if grid < 1:
        raise InputError(f"grid_attention got grid={grid}: give 1, full attention, or more.")
    for name, tensor in {"q": q, "k": k, "v": v}.items():
        if tensor.ndim != 6 or tensor.shape != q.shape:
            expected = "[B, V, h, w, H, P]" if tensor is q else tuple(q.shape)
            raise InputError(
                f"grid_attention's {name} has shape {tuple(tensor.shape)}: expected {expected}."
            )
        if not tensor.is_floating_point():
            raise InputError(
                f"grid_attention's {name} is {tensor.dtype}: give floating-point numbers."
            )
        if tensor.device != q.device:
            raise InputError(
                f"grid_attention's {name} is on {tensor.device} and q on {q.device}: move both to "
                "one device."
            )
