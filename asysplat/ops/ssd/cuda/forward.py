"""The state before each chunk, and the output of each chunk from its tokens and that state."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.ops.ssd.cuda.chunk import (
    SINCE,
    STEP,
    TO_END,
    decay_between,
    locate_decays,
    product,
    rows_of_head,
    rows_of_state,
    square_at,
    state_at,
)


@kernel
def pass_states(
    values,
    projections,
    decays,
    states,
    length,
    heads,
    chunks,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    HEAD_DIM: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Pass BLOCK columns of a head's state from chunk to chunk; with GRADIENT, from last to first.

    Args:
        values, projections: x [B, L, H, P] and B [B, L, N]; with GRADIENT, grad_output and C.
        decays: see `sum_decays`.
        states: [B, chunks, H, P, N] fp32, written: the state before each chunk, or with GRADIENT
            the gradient of the state after it.
    """
    first, head = tl.program_id(0) * BLOCK, tl.program_id(1)
    batch = tl.program_id(2).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    state = tl.zeros((HEAD_DIM, BLOCK), tl.float32)
    for k in range(chunks):
        chunk = chunks - 1 - k if GRADIENT else k
        part = (batch * chunks + chunk) * heads + head
        tl.store(states + state_at(part, first, HEAD_DIM, STATE, BLOCK), state)
        row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
        if GRADIENT:
            weight = tl.exp(tl.load(row + SINCE * positions + lane))
        else:
            weight = tl.exp(tl.load(row + TO_END * positions + lane))
            weight *= tl.load(row + STEP * positions + lane)
        at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
        value = tl.load(values + at, mask=inside, other=0.0).to(tl.float32) * weight[:, None]
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        projection = tl.load(projections + at, mask=inside, other=0.0)
        decay = tl.exp(tl.load(row + SINCE * positions + CHUNK - 1))
        state = decay * state + product(tl.trans(value), projection, DOT, PRECISION)


@kernel
def score_chunk(
    B,
    C,
    scores,
    length,
    chunks,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write the scores C_t . B_s, [B, chunks, t, s] fp32, shared by all heads."""
    chunk, batch = tl.program_id(0), tl.program_id(1).to(tl.int64)
    total = tl.zeros((CHUNK, CHUNK), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        b = tl.load(B + at, mask=inside, other=0.0)
        c = tl.load(C + at, mask=inside, other=0.0)
        total += product(c, tl.trans(b), DOT, PRECISION)
    tl.store(scores + square_at(batch, chunk, chunks, CHUNK), total)


@kernel
def forward_chunk(
    x,
    C,
    D,
    decays,
    scores,
    states,
    y,
    length,
    heads,
    chunks,
    REVERSE: tl.constexpr,
    HEAD_DIM: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write y [B, L, H, P] of a chunk and a head.

    Args:
        x, C, D: see `asysplat.ops.ssd`.
        decays: see `sum_decays`.
        scores: see `score_chunk`.
        states: [B, chunks, H, P, N] states before each chunk.
    """
    chunk, head = tl.program_id(0) // heads, tl.program_id(0) % heads
    batch = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
    part = (batch * chunks + chunk) * heads + head
    total = tl.zeros((CHUNK, HEAD_DIM), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        c = tl.load(C + at, mask=inside, other=0.0)
        at = state_at(part, first, HEAD_DIM, STATE, BLOCK)
        total += product(c, tl.trans(tl.load(states + at)), DOT, PRECISION)
    total *= tl.exp(tl.load(row + SINCE * positions + lane))[:, None]

    at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
    value = tl.load(x + at, mask=inside, other=0.0)
    weight = tl.load(scores + square_at(batch, chunk, chunks, CHUNK))
    weight *= decay_between(row, positions, CHUNK)
    weight *= tl.load(row + STEP * positions + lane)[None, :]
    total += product(weight, value, DOT, PRECISION)
    total += tl.load(D + head) * value.to(tl.float32)
    tl.store(y + at, total.to(y.dtype.element_ty), mask=inside)
