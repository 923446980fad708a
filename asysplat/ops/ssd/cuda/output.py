"""The output of each chunk, from its own tokens and from the state before it."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.ssd.cuda.decays import SINCE, STEP, decay_between, decays_of
from asysplat.ops.ssd.cuda.tile import product, rows_of_head, rows_of_state, square_at, state_at


@kernel
def multiply_vectors(
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
    """scores [B, chunks, t, s] fp32 is set to C_t . B_s, which all heads share."""
    chunk, batch = tl.program_id(0), tl.program_id(1).to(tl.int64)
    total = tl.zeros((CHUNK, CHUNK), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        b = tl.load(B + at, mask=inside, other=0.0)
        c = tl.load(C + at, mask=inside, other=0.0)
        total += product(c, tl.trans(b), DOT, PRECISION)
    tl.store(scores + square_at(batch, chunk, chunks, CHUNK), total)


@kernel
def output_chunk(
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
    WIDTH: tl.constexpr,
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
        scores: see `multiply_vectors`.
        states: [B, chunks, H, P, N] before each chunk.
    """
    chunk, head = tl.program_id(0) // heads, tl.program_id(0) % heads
    batch = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    row, positions = decays_of(decays, batch, head, heads, chunk, chunks, CHUNK)
    total = tl.zeros((CHUNK, WIDTH), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        c = tl.load(C + at, mask=inside, other=0.0)
        at = state_at(batch, chunk, chunks, head, heads, first, WIDTH, STATE, BLOCK)
        total += product(c, tl.trans(tl.load(states + at)), DOT, PRECISION)
    total *= tl.exp(tl.load(row + SINCE * positions + lane))[:, None]

    at, inside = rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK)
    value = tl.load(x + at, mask=inside, other=0.0)
    weight = tl.load(scores + square_at(batch, chunk, chunks, CHUNK))
    weight *= decay_between(row, positions, CHUNK)
    weight *= tl.load(row + STEP * positions + lane)[None, :]
    total += product(weight, value, DOT, PRECISION)
    total += tl.load(D + head) * value.to(tl.float32)
    tl.store(y + at, total.to(y.dtype.element_ty), mask=inside)
