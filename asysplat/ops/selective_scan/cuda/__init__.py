"""The selective scan for GPUs (Triton): chunks of a few tokens in parallel, states in registers.

The first kernel computes what each chunk adds to the state, the second passes the states from chunk
to chunk, and the third computes the outputs of all chunks. The backward pass does the same from the
other end. A long sequence is scanned a segment at a time, so that only what one segment needs, and
the first states of all, are in memory.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED
from asysplat.ops.scan import ScanInputs
from asysplat.ops.selective_scan.cuda.kernels import (
    backward_chunk,
    forward_chunk,
    pass_states,
    sum_chunk,
)

# Tokens of a chunk in each pass; the backward pass keeps the states of all of them in registers.
FORWARD_CHUNK, BACKWARD_CHUNK = (4, 4) if INTERPRETED else (16, 8)
TILE = 256  # numbers of the state in a program
PASS_TILE = 128  # numbers of the state in a program of `pass_states`
LAUNCH = {"num_warps": 1, **FUSED}  # all sums of a program stay in one warp
# Numbers of the states of a segment's tokens: enough work for any GPU, in 0.3 to 1.3 GB. No segment
# has fewer tokens than SHORTEST, so that the segments' first states stay smaller than x and B.
SEGMENT, SHORTEST = 2**27, 256


def saved_state_shape(x: Float[Tensor, "B L D"], B: Float[Tensor, "B L N"]) -> tuple[int]:
    """Return (0,): the backward pass needs nothing but the inputs."""
    return (0,)


def forward(
    inputs: ScanInputs, reverse: bool, keep: bool
) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "0"]]:
    """Return y and an empty saved state; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    y, state = torch.empty_like(x), _zero_state(x, A)
    with torch.cuda.device_of(x):
        for segment in _segments(x, A):
            arrays = (x, dt, A, B)
            states = _compute_states(*arrays, state, segment, FORWARD_CHUNK, reverse)
            arrays = (x, dt, A, B, C, D, states, y, segment.start)
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
    inputs = ScanInputs(*(tensor.contiguous() for tensor in inputs))
    grad_output = grad_output.contiguous()
    x, dt, A, B, C, D = inputs
    grads = ScanInputs(*(torch.empty_like(tensor) for tensor in inputs))
    grads = grads._replace(A=torch.zeros_like(A), D=torch.zeros_like(D))  # sums over segments
    segments, chunk = _segments(x, A), BACKWARD_CHUNK
    state, grad_state = _zero_state(x, A), _zero_state(x, A)
    with torch.cuda.device_of(x):
        first_states = []
        for segment in segments:
            first_states.append(state.clone())
            states = _compute_states(x, dt, A, B, state, segment, chunk, reverse)
        for segment, state in reversed(list(zip(segments, first_states, strict=True))):
            if segment != segments[-1]:  # whose states are there
                states = _compute_states(x, dt, A, B, state, segment, chunk, reverse)
            grad_states = _compute_states(
                *(grad_output, dt, A, C, grad_state, segment, chunk, reverse), gradient=True
            )
            _add_gradients(grads, grad_output, inputs, states, grad_states, segment, reverse)
    return grads


def _add_gradients(
    grads: ScanInputs,
    grad_output: Float[Tensor, "B L D"],
    inputs: ScanInputs,
    states: Float[Tensor, "B chunks D N"],
    grad_states: Float[Tensor, "B chunks D N"],
    segment: range,
    reverse: bool,
) -> None:
    """Write the gradients of a segment's x, dt, B and C, and add its part of those of A and D."""
    (batch, chunks, _, size), blocks = states.shape, _grid(states)[1]
    grad_A, grad_D = torch.empty_like(states), states.new_empty(states.shape[:3])
    grad_B, grad_C = states.new_empty(2, batch, chunks * BACKWARD_CHUNK, blocks, size)
    backward_chunk[_grid(states)](
        grad_output,
        **inputs._asdict(),
        states=states,
        grad_states=grad_states,
        grad_x=grads.x,
        grad_dt=grads.dt,
        grad_A=grad_A,
        grad_B=grad_B,
        grad_C=grad_C,
        grad_D=grad_D,
        first=segment.start,
        length=grad_output.shape[1],
        channels=grad_output.shape[2],
        CHUNK=BACKWARD_CHUNK,
        **_tile(states, reverse),
    )
    grads.A.add_(grad_A.sum((0, 1)))
    grads.D.add_(grad_D.sum((0, 1)))
    start, stop, length = segment.start, segment.stop, grad_output.shape[1]
    tokens = slice(length - stop, length - start) if reverse else slice(start, stop)
    for grad, parts in ((grads.B, grad_B), (grads.C, grad_C)):
        total = parts[:, : len(segment)].sum(2)
        grad[:, tokens] = total.flip(1) if reverse else total


def _compute_states(
    values: Tensor,
    dt: Tensor,
    A: Tensor,
    projections: Tensor,
    state: Float[Tensor, "B D N"],
    segment: range,
    chunk: int,
    reverse: bool,
    gradient: bool = False,
) -> Float[Tensor, "B chunks D N"]:
    """Return the state before each chunk, or with `gradient` the gradient of the state after it.

    `state` enters as the state before the segment and leaves as the state after it; the gradient,
    the other way around.
    """
    (batch, length, channels), size = values.shape, A.shape[1]
    chunks = -(-len(segment) // chunk)
    states = dt.new_empty(batch, chunks, channels, size)
    steps = dt.new_empty(batch, chunks, channels)
    sum_chunk[_grid(states)](
        *(values, dt, A, projections, states, steps),
        first=segment.start,
        length=length,
        channels=channels,
        GRADIENT=gradient,
        CHUNK=chunk,
        **_tile(states, reverse),
    )
    pass_states[(-(-channels * size // PASS_TILE), batch)](
        *(A, steps, states, state, chunks, channels),
        GRADIENT=gradient,
        STATE=size,
        BLOCK=PASS_TILE,
        **LAUNCH,
    )
    return states


def _segments(x: Float[Tensor, "B L D"], A: Float[Tensor, "D N"]) -> list[range]:
    (batch, length, _), chunk = x.shape, max(FORWARD_CHUNK, BACKWARD_CHUNK)
    size = max(SEGMENT // (batch * A.numel()), SHORTEST) // chunk * chunk
    return [range(start, min(start + size, length)) for start in range(0, length, size)]


def _zero_state(x: Float[Tensor, "B L D"], A: Float[Tensor, "D N"]) -> Float[Tensor, "B D N"]:
    return A.new_zeros(len(x), *A.shape)


def _grid(states: Tensor) -> tuple[int, int, int]:
    batch, chunks, channels, size = states.shape
    return chunks, -(-channels * size // TILE), batch


def _tile(states: Tensor, reverse: bool) -> dict[str, int | bool]:
    size = states.shape[-1]
    return {"REVERSE": reverse, "STATE": size, "BLOCK": TILE // size, **LAUNCH}
