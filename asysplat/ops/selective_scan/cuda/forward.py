"""The state before each chunk, and the output of each chunk from its tokens and that state.

With GRADIENT, the kernels go from the last chunk to the first and through each chunk from its end,
and pass on the gradient of the state before a token.
"""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.ops.selective_scan.cuda.chunk import (
    load_channels,
    load_projection,
    locate,
    row_at,
)

AHEAD = tl.constexpr(8)  # chunks that a program loads at once


@kernel
def sum_chunk(
    values,
    dt,
    A,
    projections,
    states,
    steps,
    first,
    length,
    channels,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write what a chunk's tokens add to the state, and the sum of their steps.

    Args:
        values, projections: x [B, L, D] and B [B, L, N]; with GRADIENT, grad_output and C.
        states: [B, chunks, D, N], written: what the tokens add.
        steps: [B, chunks, D], written: the sum of dt.
        first: position of the segment's first token.
    """
    batch, chunk, channel, exists, entry = locate(channels, STATE, BLOCK)
    rate = tl.load(A + entry, mask=exists[:, None], other=0.0)
    state = tl.zeros_like(rate)
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(CHUNK):
        position = first + chunk * CHUNK + (CHUNK - 1 - k if GRADIENT else k)
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(values, token, limit, channel)
        projection = load_projection(projections, batch, position, length, STATE, REVERSE)
        decay = tl.exp(step[:, None] * rate)
        if GRADIENT:
            state = decay * (state + value[:, None] * projection)
        else:
            state = decay * state + (step * value)[:, None] * projection
        total += step
    row = (batch * tl.num_programs(0) + chunk) * channels
    tl.store(states + row * STATE + entry, state, mask=exists[:, None])
    tl.store(steps + row + channel, total, mask=exists)


@kernel
def pass_states(
    A,
    steps,
    states,
    carry,
    chunks,
    channels,
    GRADIENT: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Replace each chunk's addition by the state before the chunk; see `sum_chunk`.

    With GRADIENT, replace it by the gradient of the state after the chunk.

    Args:
        carry: [B, D, N], the state before the segment, or the gradient after it; the other end's is
            written.
    """
    entry = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    batch = tl.program_id(1).to(tl.int64)
    size = channels * STATE
    rate = tl.load(A + entry, mask=entry < size, other=0.0)
    place = carry + batch * size + entry
    state = tl.load(place, mask=entry < size, other=0.0)
    for start in range(0, chunks, AHEAD):
        # All loads come first, so that they overlap.
        added, totals = (), ()
        for k in tl.static_range(AHEAD):
            row, limit = row_at(batch, start + k, chunks, size, GRADIENT)
            added = added + (load_channels(states, row, limit, entry),)
            row, limit = row_at(batch, start + k, chunks, channels, GRADIENT)
            totals = totals + (load_channels(steps, row, limit, entry // STATE),)
        for k in tl.static_range(AHEAD):
            row, limit = row_at(batch, start + k, chunks, size, GRADIENT)
            tl.store(states + row + entry, state, mask=entry < limit)
            state = tl.exp(totals[k] * rate) * state + added[k]
    tl.store(place, state, mask=entry < size)


@kernel
def forward_chunk(
    x,
    dt,
    A,
    B,
    C,
    D,
    states,
    y,
    first,
    length,
    channels,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write y [B, L, D].

    Args:
        x, dt, A, B, C, D: see `asysplat.ops.selective_scan`.
        states: [B, chunks, D, N] states before each chunk.
        first: position of the segment's first token.
    """
    batch, chunk, channel, exists, entry = locate(channels, STATE, BLOCK)
    rate = tl.load(A + entry, mask=exists[:, None], other=0.0)
    skip = tl.load(D + channel, mask=exists, other=0.0)
    row = (batch * tl.num_programs(0) + chunk) * channels
    state = tl.load(states + row * STATE + entry, mask=exists[:, None], other=0.0)
    for k in tl.static_range(CHUNK):
        position = first + chunk * CHUNK + k
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(x, token, limit, channel)
        state = tl.exp(step[:, None] * rate) * state + (step * value)[:, None] * load_projection(
            B, batch, position, length, STATE, REVERSE
        )
        out = tl.sum(state * load_projection(C, batch, position, length, STATE, REVERSE), 1)
        out = (out + skip * value).to(y.dtype.element_ty)
        tl.store(y + token + channel, out, mask=channel < limit)
