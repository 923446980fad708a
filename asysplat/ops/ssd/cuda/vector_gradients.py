"""The gradients of what the heads share: B and C, summed over heads in their order."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.ssd.cuda.decays import SINCE, STEP, TO_END, decay_between, decays_of
from asysplat.ops.ssd.cuda.tile import product, rows_of_head, rows_of_state, square_at, state_at


@kernel
def score_gradients(
    grad_y,
    x,
    decays,
    grad_scores,
    length,
    heads,
    chunks,
    REVERSE: tl.constexpr,
    WIDTH: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """grad_scores [B, chunks, t, s] fp32 is set to the gradient of C_t . B_s.

    Args:
        grad_y, x: [B, L, H, P].
        decays: see `sum_decays`.
    """
    chunk, batch = tl.program_id(0), tl.program_id(1).to(tl.int64)
    total = tl.zeros((CHUNK, CHUNK), tl.float32)
    for head in range(heads):
        at, inside = rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK)
        value = tl.load(x + at, mask=inside, other=0.0)
        out = tl.load(grad_y + at, mask=inside, other=0.0)
        row, positions = decays_of(decays, batch, head, heads, chunk, chunks, CHUNK)
        step = tl.load(row + STEP * positions + tl.arange(0, CHUNK))
        weight = decay_between(row, positions, CHUNK) * step[None, :]
        total += weight * product(out, tl.trans(value), DOT, PRECISION)
    tl.store(grad_scores + square_at(batch, chunk, chunks, CHUNK), total)


@kernel
def vector_gradients(
    values,
    vectors,
    decays,
    grad_scores,
    states,
    grad_vectors,
    length,
    heads,
    chunks,
    OF_B: tl.constexpr,
    REVERSE: tl.constexpr,
    WIDTH: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """grad_vectors [B, L, N] is set to the gradient of B or C, BLOCK columns of a chunk's tokens.

    Args:
        values, vectors, states: x, C and the gradients of the states after the chunks with OF_B;
            else grad_y, B and the states before them.
        decays: see `sum_decays`.
        grad_scores: see `score_gradients`.
    """
    first, chunk = tl.program_id(0) * BLOCK, tl.program_id(1)
    batch = tl.program_id(2).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    to, there = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
    vector = tl.load(vectors + to, mask=there, other=0.0)
    square = tl.load(grad_scores + square_at(batch, chunk, chunks, CHUNK))
    if OF_B:
        square = tl.trans(square)
    total = product(square, vector, DOT, PRECISION)
    for head in range(heads):
        row, positions = decays_of(decays, batch, head, heads, chunk, chunks, CHUNK)
        if OF_B:
            weight = tl.exp(tl.load(row + TO_END * positions + lane))
            weight *= tl.load(row + STEP * positions + lane)
        else:
            weight = tl.exp(tl.load(row + SINCE * positions + lane))
        at, inside = rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK)
        value = tl.load(values + at, mask=inside, other=0.0).to(tl.float32) * weight[:, None]
        at = state_at(batch, chunk, chunks, head, heads, first, WIDTH, STATE, BLOCK)
        total += product(value, tl.load(states + at), DOT, PRECISION)
    tl.store(grad_vectors + to, total.to(grad_vectors.dtype.element_ty), mask=there)
