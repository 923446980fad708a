"""SSD for CPUs (Numba): matrix products within chunks, the state passed on between them.

Dao and Gu 2024, Section 6. A task takes a head through a segment of chunks: its state and all
intermediate results stay in a core's cache. Only the state before each segment is stored between
the passes.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import run_blocks
from asysplat.kernels.simd.vectors import LANES
from asysplat.ops.scan import ScanInputs
from asysplat.ops.ssd.cpu.kernels import (
    Decays,
    GroupGradients,
    HeadGradients,
    Segment,
    backward_heads,
    forward_heads,
)
from asysplat.ops.ssd.reference import CHUNK

SEGMENT = 16 * CHUNK  # tokens: a head's states before a segment's chunks are 1 MB at paper scale
GROUP = 2  # heads of a group: one core sums their gradients of B and C


def saved_state_shape(x: Float[Tensor, "B L H P"], B: Float[Tensor, "B L N"]) -> tuple:
    """Return the shape of the states before segments, [B, segments, H, N, P in whole vectors]."""
    batch, length, heads, head_dim = x.shape
    return batch, -(-length // SEGMENT), heads, B.shape[-1], _round_up_to_vectors(head_dim)


def forward(
    inputs: ScanInputs, reverse: bool, keep: bool
) -> tuple[Float[Tensor, "B L H P"], Float[Tensor, "_ _ _ _ _"]]:
    """Return y and the states before each segment; see `asysplat.ops.scan`."""
    y = torch.empty_like(inputs.x)
    shape = saved_state_shape(inputs.x, inputs.B)
    saved_state = torch.empty(shape if keep else (0,) * len(shape))
    for batch in range(len(y)):
        states = torch.zeros(shape[2:])
        for index, tokens in _iterate_segments(y.shape[1], reverse):
            if keep:
                saved_state[batch, index] = states
            segment = _make_segment(inputs, batch, tokens, reverse)
            with _open_target(y[batch, tokens], len(segment.x)) as out:
                run_blocks(forward_heads, np.arange(len(states) + 1), segment, states.numpy(), out)
    return y, saved_state


def backward(
    grad_output: Float[Tensor, "B L H P"], inputs: ScanInputs, saved_state: Tensor, reverse: bool
) -> ScanInputs:
    """Return the gradients of the inputs; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = inputs
    state_size = B.shape[-1]
    grads = ScanInputs(
        x=torch.empty_like(x),
        dt=torch.empty_like(dt),
        A=torch.zeros_like(A, dtype=torch.float64),
        B=torch.empty_like(B),
        C=torch.empty_like(C),
        D=torch.zeros_like(D, dtype=torch.float64),
    )
    groups, chunks = -(-len(A) // GROUP), SEGMENT // CHUNK
    group_grads = [
        torch.empty(chunks, groups, CHUNK, columns)
        for columns in (_round_up_to_vectors(state_size), _round_up_to_vectors(state_size), CHUNK)
    ]
    for batch in range(len(grad_output)):
        grad_states = torch.zeros(saved_state.shape[2:])
        for index, tokens in reversed(list(_iterate_segments(grad_output.shape[1], reverse))):
            segment = _make_segment(inputs, batch, tokens, reverse)
            length, parts = len(segment.x), [part[: len(segment.B)] for part in group_grads]
            with (
                _open_target(grads.x[batch, tokens], length) as grad_x,
                _open_target(grads.dt[batch, tokens], length) as grad_dt,
            ):
                run_blocks(
                    backward_heads,
                    np.arange(groups + 1),
                    segment,
                    saved_state[batch, index].numpy(),
                    _pad_to_chunks(grad_output[batch, tokens]).numpy(),
                    grad_states.numpy(),
                    HeadGradients(grad_x, grad_dt, grads.A.numpy(), grads.D.numpy()),
                    GroupGradients(*(part.numpy() for part in parts)),
                )
            grad_B, grad_C, grad_scores = (part.sum(1) for part in parts)
            from_scores_B = grad_scores.mT @ torch.from_numpy(segment.C)
            from_scores_C = grad_scores @ torch.from_numpy(segment.B)
            _write(grads.B[batch, tokens], grad_B[..., :state_size] + from_scores_B)
            _write(grads.C[batch, tokens], grad_C[..., :state_size] + from_scores_C)
    return grads._replace(A=grads.A.float(), D=grads.D.float())


def _iterate_segments(length: int, reverse: bool) -> Iterator[tuple[int, slice]]:
    indices = range(-(-length // SEGMENT))
    for index in reversed(indices) if reverse else indices:
        yield index, slice(index * SEGMENT, min((index + 1) * SEGMENT, length))


def _make_segment(inputs: ScanInputs, batch: int, tokens: slice, reverse: bool) -> Segment:
    """Return a segment of one sequence, padded to whole chunks with dt = 0: no state changes."""
    x, dt, B, C = (
        _pad_to_chunks(tensor[batch, tokens])
        for tensor in (inputs.x, inputs.dt, inputs.B, inputs.C)
    )
    B, C = B.unflatten(0, (-1, CHUNK)), C.unflatten(0, (-1, CHUNK))
    return Segment(
        x=x.numpy(),
        dt=dt.numpy(),
        A=inputs.A.numpy(),
        B=B.numpy(),
        C=C.numpy(),
        D=inputs.D.clone().numpy(),  # a view would keep FSDP from freeing the parameter
        scores=(C @ B.mT).numpy(),
        decays=_sum_decays(dt.unflatten(0, (-1, CHUNK)), inputs.A, reverse),
        reverse=reverse,
    )


def _sum_decays(dt: Float[Tensor, "c q h"], A: Float[Tensor, "h"], reverse: bool) -> Decays:
    """Sum the log decays in float64 along the scan, from the start of each chunk."""
    logs = (dt.double() * A.double() / math.log(2)).transpose(1, 2)
    logs = logs.flip(-1).cumsum(-1).flip(-1) if reverse else logs.cumsum(-1)
    total = logs[..., :1] if reverse else logs[..., -1:]
    high = logs.float()
    decays = (high, logs - high, logs.exp2(), (total - logs).exp2(), total.squeeze(-1).exp2())
    return Decays(*(part.float().contiguous().numpy() for part in decays))


def _pad_to_chunks(tokens: Tensor) -> Tensor:
    """Return [l ...] in fp32, padded with zeros to whole chunks."""
    missing = -len(tokens) % CHUNK
    if missing:
        tokens = F.pad(tokens, (0, 0) * (tokens.ndim - 1) + (0, missing))
    return tokens.float().contiguous()


def _round_up_to_vectors(count: int | torch.SymInt) -> int | torch.SymInt:
    return -(-count // LANES) * LANES


@contextmanager
def _open_target(target: Tensor, length: int) -> Iterator[np.ndarray]:
    """Yield an fp32 array of `length` tokens: `target`, or an array that is then copied to it.

    The tokens of the array fill whole chunks; `target` may have fewer, and another type.
    """
    if len(target) == length and target.dtype == torch.float32:
        yield target.numpy()
        return
    whole = torch.empty(length, *target.shape[1:])
    yield whole.numpy()
    target.copy_(whole[: len(target)])


def _write(target: Tensor, chunks: Tensor) -> None:
    """Copy the tokens of [c, q, N] to `target`, without the padding."""
    target.copy_(chunks.flatten(0, 1)[: len(target)])
