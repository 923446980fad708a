"""The stages of the scan and of its gradients, one after the other."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.cuda.scans import FUSED, INTERPRETED, check_size
from asysplat.ops.selective_scan.cuda.chunk import scan_chunk
from asysplat.ops.selective_scan.cuda.chunk_backward import scan_chunk_backward
from asysplat.ops.selective_scan.cuda.states import add_up, pass_on

# Tokens of a chunk; the backward pass keeps all their states in registers.
FORWARD_CHUNK, BACKWARD_CHUNK = (4, 4) if INTERPRETED else (16, 8)
TILE = 256  # numbers of the state in a program
PASSED = 128  # of it, where it goes from chunk to chunk
WARP = {"num_warps": 1, **FUSED}  # no sum leaves it


def carried_shape(x: Float[Tensor, "B L D"], B: Float[Tensor, "B L N"]) -> tuple[int]:
    """Nothing but the inputs."""
    return (0,)


def forward(
    x: Float[Tensor, "B L D"],
    dt: Float[Tensor, "B L D"],
    A: Float[Tensor, "D N"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "D"],
    reverse: bool,
    keep: bool,
) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "0"]]:
    """y, and an empty tensor, which is all there is to keep; see `asysplat.ops.selective_scan`.

    Raises:
        InputError: a state size that is no power of two from 16 to 256.
    """
    check_size("selective_scan", "state size", B.shape[-1], TILE)
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in (x, dt, A, B, C, D))
    y = torch.empty_like(x)
    with torch.cuda.device_of(x):
        states = _states(x, dt, A, B, FORWARD_CHUNK, reverse, gradient=False)
        scan_chunk[_grid(states)](
            *(x, dt, A, B, C, D, states, y),
            *x.shape[1:],
            CHUNK=FORWARD_CHUNK,
            **_tile(states, reverse),
        )
    return y, dt.new_empty(carried_shape(x, B))


def backward(
    grad_y: Float[Tensor, "B L D"],
    x: Float[Tensor, "B L D"],
    dt: Float[Tensor, "B L D"],
    A: Float[Tensor, "D N"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "D"],
    carried: Float[Tensor, "0"],
    reverse: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of x, dt, A, B, C and D."""
    inputs = (grad_y, x, dt, A, B, C, D)
    grad_y, x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    grad_x, grad_dt = torch.empty_like(x), torch.empty_like(dt)
    with torch.cuda.device_of(x):
        states = _states(x, dt, A, B, BACKWARD_CHUNK, reverse, gradient=False)
        grad_states = _states(grad_y, dt, A, C, BACKWARD_CHUNK, reverse, gradient=True)
        grad_A, grad_D = torch.empty_like(states), states.new_empty(states.shape[:3])
        grid = _grid(states)
        parts = (*x.shape[:2], grid[1], B.shape[2])
        grad_B, grad_C = states.new_empty(parts), states.new_empty(parts)
        scan_chunk_backward[grid](
            *(grad_y, x, dt, A, B, C, D, states, grad_states),
            *(grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D),
            *x.shape[1:],
            CHUNK=BACKWARD_CHUNK,
            **_tile(states, reverse),
        )
    grad_B, grad_C = (part.sum(2).to(x.dtype) for part in (grad_B, grad_C))
    return grad_x, grad_dt, grad_A.sum((0, 1)), grad_B, grad_C, grad_D.sum((0, 1))


def _states(
    values: Tensor,
    dt: Tensor,
    A: Tensor,
    vectors: Tensor,
    chunk: int,
    reverse: bool,
    gradient: bool,
) -> Float[Tensor, "B chunks D N"]:
    """Before each chunk, or with `gradient` the gradient of the state after it."""
    (batch, length, channels), state = values.shape, A.shape[1]
    chunks = -(-length // chunk)
    states = dt.new_empty(batch, chunks, channels, state)
    steps = dt.new_empty(batch, chunks, channels)
    add_up[_grid(states)](
        *(values, dt, A, vectors, states, steps, length, channels),
        GRADIENT=gradient,
        CHUNK=chunk,
        **_tile(states, reverse),
    )
    pass_on[(-(-channels * state // PASSED), batch)](
        *(A, steps, states, chunks, channels),
        GRADIENT=gradient,
        STATE=state,
        BLOCK=PASSED,
        **WARP,
    )
    return states


def _grid(states: Tensor) -> tuple[int, int, int]:
    batch, chunks, channels, state = states.shape
    return chunks, -(-channels * state // TILE), batch


def _tile(states: Tensor, reverse: bool) -> dict[str, int | bool]:
    state = states.shape[-1]
    return {"REVERSE": reverse, "STATE": state, "BLOCK": TILE // state, **WARP}
