"""Both passes: the kernels' arrays and launches."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED
from asysplat.ops.scan import ScanInputs
from asysplat.ops.selective_scan.cuda.backward import backward_chunk
from asysplat.ops.selective_scan.cuda.forward import forward_chunk, pass_states, sum_chunk

# Tokens of a chunk in each pass; the backward pass keeps the states of all of them in registers.
FORWARD_CHUNK, BACKWARD_CHUNK = (4, 4) if INTERPRETED else (16, 8)
TILE = 256  # numbers of the state in a program
PASS_TILE = 128  # numbers of the state in a program of `pass_states`
LAUNCH = {"num_warps": 1, **FUSED}  # all sums of a program stay in one warp


def saved_state_shape(x: Float[Tensor, "B L D"], B: Float[Tensor, "B L N"]) -> tuple[int]:
    """Return (0,): the backward pass needs nothing but the inputs."""
    return (0,)


def forward(
    inputs: ScanInputs, reverse: bool, keep: bool
) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "0"]]:
    """Return y and an empty saved state; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    y = torch.empty_like(x)
    with torch.cuda.device_of(x):
        states = _compute_states(x, dt, A, B, FORWARD_CHUNK, reverse, gradient=False)
        arrays = (x, dt, A, B, C, D, states, y)
        forward_chunk[_grid(states)](
            *arrays, *x.shape[1:], CHUNK=FORWARD_CHUNK, **_tile(states, reverse)
        )
    return y, dt.new_empty(saved_state_shape(x, B))


def backward(
    grad_output: Float[Tensor, "B L D"],
    inputs: ScanInputs,
    saved_state: Float[Tensor, "0"],
    reverse: bool,
) -> ScanInputs:
    """Return the gradients of the inputs; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    grad_output = grad_output.contiguous()
    grad_x, grad_dt = torch.empty_like(x), torch.empty_like(dt)
    with torch.cuda.device_of(x):
        states = _compute_states(x, dt, A, B, BACKWARD_CHUNK, reverse, gradient=False)
        grad_states = _compute_states(grad_output, dt, A, C, BACKWARD_CHUNK, reverse, gradient=True)
        grad_A, grad_D = torch.empty_like(states), states.new_empty(states.shape[:3])
        grid = _grid(states)
        parts = (*x.shape[:2], grid[1], B.shape[2])
        grad_B, grad_C = states.new_empty(parts), states.new_empty(parts)
        backward_chunk[grid](
            *(grad_output, x, dt, A, B, C, D),
            states=states,
            grad_states=grad_states,
            grad_x=grad_x,
            grad_dt=grad_dt,
            grad_A=grad_A,
            grad_B=grad_B,
            grad_C=grad_C,
            grad_D=grad_D,
            length=x.shape[1],
            channels=x.shape[2],
            CHUNK=BACKWARD_CHUNK,
            **_tile(states, reverse),
        )
    return ScanInputs(
        x=grad_x,
        dt=grad_dt,
        A=grad_A.sum((0, 1)),
        B=grad_B.sum(2).to(x.dtype),
        C=grad_C.sum(2).to(x.dtype),
        D=grad_D.sum((0, 1)),
    )


def _compute_states(
    values: Tensor,
    dt: Tensor,
    A: Tensor,
    projections: Tensor,
    chunk: int,
    reverse: bool,
    gradient: bool,
) -> Float[Tensor, "B chunks D N"]:
    """Return the state before each chunk, or with `gradient` the gradient of the state after it."""
    (batch, length, channels), state = values.shape, A.shape[1]
    chunks = -(-length // chunk)
    states = dt.new_empty(batch, chunks, channels, state)
    steps = dt.new_empty(batch, chunks, channels)
    sum_chunk[_grid(states)](
        *(values, dt, A, projections, states, steps, length, channels),
        GRADIENT=gradient,
        CHUNK=chunk,
        **_tile(states, reverse),
    )
    pass_states[(-(-channels * state // PASS_TILE), batch)](
        *(A, steps, states, chunks, channels),
        GRADIENT=gradient,
        STATE=state,
        BLOCK=PASS_TILE,
        **LAUNCH,
    )
    return states


def _grid(states: Tensor) -> tuple[int, int, int]:
    batch, chunks, channels, state = states.shape
    return chunks, -(-channels * state // TILE), batch


def _tile(states: Tensor, reverse: bool) -> dict[str, int | bool]:
    state = states.shape[-1]
    return {"REVERSE": reverse, "STATE": state, "BLOCK": TILE // state, **LAUNCH}
