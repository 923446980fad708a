"""Attention among the tokens of all views at the same place in a p_g x p_g grid (Sec. 3.3)."""

from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.kernels.dispatch import check_device, check_float, check_shape, look_up_backend
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
    """Attend from token (i, j) of each view to the tokens (i + a p_g, j + b p_g) of all views.

    Here a and b are any integers for which the token exists.

    Args:
        q, k, v: queries, keys and values of the h x w tokens of V views; P is the head_dim.
        grid: p_g, the side of the grid in tokens; 1 is full attention.
        backend: "sdpa" (torch's fused attention), "reference", or "auto", which is "sdpa".
    """
    implementation = look_up_backend("grid_attention", _BACKENDS, backend)
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
