"""The gradients of what each head has of its own: x, dt, A and D."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.ssd.cuda.decays import SINCE, STEP, TO_END, decay_between, decays_of
from asysplat.ops.ssd.cuda.tile import product, rows_of_head, rows_of_state, square_at, state_at


@kernel
def head_gradients(
    grad_y,
    x,
    A,
    B,
    C,
    D,
    decays,
    scores,
    states,
    grad_states,
    grad_x,
    grad_dt,
    grad_A,
    grad_D,
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
    """Those of a chunk and a head.

    The gradient of a token's log decay is the sum over all pairs of an input before it and an
    output not before it. They are summed as they are, and never as a difference of larger sums.

    Args:
        grad_y, x, A, B, C, D: see `asysplat.ops.ssd`.
        decays: see `sum_decays`.
        scores: see `multiply_vectors`.
        states, grad_states: [B, chunks, H, P, N] before, and of what is after, each chunk.
        grad_x, grad_dt: [B, L, H, P] and [B, L, H].
        grad_A, grad_D: [B, chunks, H], parts.
    """
    chunk, head = tl.program_id(0) // heads, tl.program_id(0) % heads
    batch = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    row, positions = decays_of(decays, batch, head, heads, chunk, chunks, CHUNK)
    step = tl.load(row + STEP * positions + lane)

    # From the states: what flows in from before the chunk, out behind it, and through.
    grad_input = tl.zeros((CHUNK, WIDTH), tl.float32)
    read = tl.zeros((CHUNK, WIDTH), tl.float32)
    through = tl.zeros((WIDTH,), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        b = tl.load(B + at, mask=inside, other=0.0)
        c = tl.load(C + at, mask=inside, other=0.0)
        at = state_at(batch, chunk, chunks, head, heads, first, WIDTH, STATE, BLOCK)
        state, grad_state = tl.load(states + at), tl.load(grad_states + at)
        read += product(c, tl.trans(state), DOT, PRECISION)
        grad_input += product(b, tl.trans(grad_state), DOT, PRECISION)
        through += tl.sum(state * grad_state, 1)
    at, inside = rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK)
    value = tl.load(x + at, mask=inside, other=0.0)
    out = tl.load(grad_y + at, mask=inside, other=0.0)
    flows_in = tl.exp(tl.load(row + SINCE * positions + lane))
    flows_in *= tl.sum(read * out.to(tl.float32), 1)
    grad_input *= tl.exp(tl.load(row + TO_END * positions + lane))[:, None]
    flows_out = step * tl.sum(grad_input * value.to(tl.float32), 1)
    flows_through = tl.exp(tl.load(row + SINCE * positions + CHUNK - 1)) * tl.sum(through, 0)

    # Within the chunk, from position s to position t.
    weight = tl.load(scores + square_at(batch, chunk, chunks, CHUNK))
    weight *= decay_between(row, positions, CHUNK)
    grad_input += product(tl.trans(weight), out, DOT, PRECISION)
    flows = weight * product(out, tl.trans(value), DOT, PRECISION) * step[None, :]
    flows = tl.cumsum(flows, 0, reverse=True) + flows_out[None, :]
    flows = tl.where(lane[:, None] > lane[None, :], flows, 0.0)
    grad_exponent = tl.sum(flows, 1) + tl.cumsum(flows_in, 0, reverse=True) + flows_through

    value = value.to(tl.float32)
    out = out.to(tl.float32)
    result = step[:, None] * grad_input + tl.load(D + head) * out
    tl.store(grad_x + at, result.to(grad_x.dtype.element_ty), mask=inside)
    grad_step = tl.load(A + head) * grad_exponent + tl.sum(value * grad_input, 1)
    at, inside = rows_of_head(batch, chunk, head, length, heads, 1, REVERSE, CHUNK)
    tl.store(grad_dt + at, grad_step[:, None], mask=inside)
    part = (batch * chunks + chunk) * heads + head
    tl.store(grad_A + part, tl.sum(step * grad_exponent, 0))
    tl.store(grad_D + part, tl.sum(tl.sum(value * out, 1), 0))
