"""The gradients of x, dt, A and D of each head, and of B and C, which all heads share."""

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
def head_gradients(
    grad_output,
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
    HEAD_DIM: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write the gradients of x, dt, A and D for a chunk and a head.

    The gradient of a token's log decay is a sum over all pairs of an input before the token and an
    output at or after it. It is summed directly, never as a difference of larger sums.

    Args:
        grad_output, x, A, B, C, D: see `asysplat.ops.ssd`.
        decays: see `sum_decays`.
        scores: see `score_chunk`.
        states: [B, chunks, H, P, N] states before each chunk.
        grad_states: [B, chunks, H, P, N] gradients of the states after each chunk.
        grad_x, grad_dt: [B, L, H, P] and [B, L, H], written.
        grad_A, grad_D: [B, chunks, H], written, to be summed over sequences and chunks.
    """
    chunk, head = tl.program_id(0) // heads, tl.program_id(0) % heads
    batch = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
    step = tl.load(row + STEP * positions + lane)
    part = (batch * chunks + chunk) * heads + head

    # Gradients through the states: from before the chunk, to after it, and across it.
    grad_input = tl.zeros((CHUNK, HEAD_DIM), tl.float32)
    read = tl.zeros((CHUNK, HEAD_DIM), tl.float32)
    through = tl.zeros((HEAD_DIM,), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        b = tl.load(B + at, mask=inside, other=0.0)
        c = tl.load(C + at, mask=inside, other=0.0)
        at = state_at(part, first, HEAD_DIM, STATE, BLOCK)
        state, grad_state = tl.load(states + at), tl.load(grad_states + at)
        read += product(c, tl.trans(state), DOT, PRECISION)
        grad_input += product(b, tl.trans(grad_state), DOT, PRECISION)
        through += tl.sum(state * grad_state, 1)
    at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
    value = tl.load(x + at, mask=inside, other=0.0)
    out = tl.load(grad_output + at, mask=inside, other=0.0)
    flows_in = tl.exp(tl.load(row + SINCE * positions + lane))
    flows_in *= tl.sum(read * out.to(tl.float32), 1)
    grad_input *= tl.exp(tl.load(row + TO_END * positions + lane))[:, None]
    flows_out = step * tl.sum(grad_input * value.to(tl.float32), 1)
    flows_across = tl.exp(tl.load(row + SINCE * positions + CHUNK - 1)) * tl.sum(through, 0)

    # Gradients within the chunk, from position s to position t.
    weight = tl.load(scores + square_at(batch, chunk, chunks, CHUNK))
    weight *= decay_between(row, positions, CHUNK)
    grad_input += product(tl.trans(weight), out, DOT, PRECISION)
    flows = weight * product(out, tl.trans(value), DOT, PRECISION) * step[None, :]
    flows = tl.cumsum(flows, 0, reverse=True) + flows_out[None, :]
    flows = tl.where(lane[:, None] > lane[None, :], flows, 0.0)
    grad_exponent = tl.sum(flows, 1) + tl.cumsum(flows_in, 0, reverse=True) + flows_across

    value = value.to(tl.float32)
    out = out.to(tl.float32)
    result = step[:, None] * grad_input + tl.load(D + head) * out
    tl.store(grad_x + at, result.to(grad_x.dtype.element_ty), mask=inside)
    grad_step = tl.load(A + head) * grad_exponent + tl.sum(value * grad_input, 1)
    at, inside = rows_of_head(batch, chunk, head, length, heads, 1, REVERSE, CHUNK)
    tl.store(grad_dt + at, grad_step[:, None], mask=inside)
    tl.store(grad_A + part, tl.sum(step * grad_exponent, 0))
    tl.store(grad_D + part, tl.sum(tl.sum(value * out, 1), 0))


@kernel
def score_gradients(
    grad_output,
    x,
    decays,
    grad_scores,
    length,
    heads,
    chunks,
    REVERSE: tl.constexpr,
    HEAD_DIM: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write the gradient of the scores C_t . B_s, [B, chunks, t, s] fp32, summed over the heads.

    Args:
        grad_output, x: [B, L, H, P].
        decays: see `sum_decays`.
    """
    chunk, batch = tl.program_id(0), tl.program_id(1).to(tl.int64)
    total = tl.zeros((CHUNK, CHUNK), tl.float32)
    for head in range(heads):
        at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
        value = tl.load(x + at, mask=inside, other=0.0)
        out = tl.load(grad_output + at, mask=inside, other=0.0)
        row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
        step = tl.load(row + STEP * positions + tl.arange(0, CHUNK))
        weight = decay_between(row, positions, CHUNK) * step[None, :]
        total += weight * product(out, tl.trans(value), DOT, PRECISION)
    tl.store(grad_scores + square_at(batch, chunk, chunks, CHUNK), total)


@kernel
def projection_gradients(
    values,
    projections,
    decays,
    grad_scores,
    states,
    grad_projections,
    length,
    heads,
    chunks,
    OF_B: tl.constexpr,
    REVERSE: tl.constexpr,
    HEAD_DIM: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write BLOCK columns of the gradient of B or C, [B, L, N], for a chunk's tokens.

    The heads are summed in their order.

    Args:
        values, projections, states: for B (OF_B), x, C and the gradients of the states after each
            chunk; for C, grad_output, B and the states before each chunk.
        decays: see `sum_decays`.
        grad_scores: see `score_gradients`.
    """
    first, chunk = tl.program_id(0) * BLOCK, tl.program_id(1)
    batch = tl.program_id(2).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    to, exists = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
    projection = tl.load(projections + to, mask=exists, other=0.0)
    square = tl.load(grad_scores + square_at(batch, chunk, chunks, CHUNK))
    if OF_B:
        square = tl.trans(square)
    total = product(square, projection, DOT, PRECISION)
    for head in range(heads):
        row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
        if OF_B:
            weight = tl.exp(tl.load(row + TO_END * positions + lane))
            weight *= tl.load(row + STEP * positions + lane)
        else:
            weight = tl.exp(tl.load(row + SINCE * positions + lane))
        at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
        value = tl.load(values + at, mask=inside, other=0.0).to(tl.float32) * weight[:, None]
        part = (batch * chunks + chunk) * heads + head
        at = state_at(part, first, HEAD_DIM, STATE, BLOCK)
        total += product(value, tl.load(states + at), DOT, PRECISION)
    tl.store(grad_projections + to, total.to(grad_projections.dtype.element_ty), mask=exists)
