"""The state before each chunk, or the gradient of the state after it."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.ssd.cuda.decays import SINCE, STEP, TO_END, decays_of
from asysplat.ops.ssd.cuda.tile import product, rows_of_head, rows_of_state, state_at


@kernel
def pass_on(
    values,
    vectors,
    decays,
    states,
    length,
    heads,
    chunks,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    WIDTH: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Go through the chunks with BLOCK columns of a head's state; with GRADIENT, from the last.

    Args:
        values, vectors: x [B, L, H, P] and B [B, L, N]; with GRADIENT, grad_y and C.
        states: [B, chunks, H, P, N] fp32, written.
    """
    first, head = tl.program_id(0) * BLOCK, tl.program_id(1)
    batch = tl.program_id(2).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    state = tl.zeros((WIDTH, BLOCK), tl.float32)
    for k in range(chunks):
        chunk = chunks - 1 - k if GRADIENT else k
        tl.store(
            states + state_at(batch, chunk, chunks, head, heads, first, WIDTH, STATE, BLOCK), state
        )
        row, positions = decays_of(decays, batch, head, heads, chunk, chunks, CHUNK)
        if GRADIENT:
            weight = tl.exp(tl.load(row + SINCE * positions + lane))
        else:
            weight = tl.exp(tl.load(row + TO_END * positions + lane))
            weight *= tl.load(row + STEP * positions + lane)
        at, inside = rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK)
        value = tl.load(values + at, mask=inside, other=0.0).to(tl.float32) * weight[:, None]
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        vector = tl.load(vectors + at, mask=inside, other=0.0)
        decay = tl.exp(tl.load(row + SINCE * positions + CHUNK - 1))
        state = decay * state + product(tl.trans(value), vector, DOT, PRECISION)
