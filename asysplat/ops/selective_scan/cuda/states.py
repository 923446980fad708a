"""The state, or its gradient, before each chunk.

With GRADIENT a chunk is gone through from its end, and what is passed on is the gradient of the
state before a token.
"""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.selective_scan.cuda.tile import load_channels, load_vector, place, row_at

AHEAD = tl.constexpr(8)  # chunks


@kernel
def add_up(
    values,
    dt,
    A,
    vectors,
    states,
    steps,
    length,
    channels,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """What a chunk's own tokens leave in the state.

    Args:
        values, vectors: x [B, L, D] and B [B, L, N]; with GRADIENT, grad_y and C.
        states: [B, chunks, D, N] is set to it.
        steps: [B, chunks, D] is set to the sum of dt.
    """
    batch, chunk, channel, there, entry = place(channels, STATE, BLOCK)
    rate = tl.load(A + entry, mask=there[:, None], other=0.0)
    state = tl.zeros_like(rate)
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(CHUNK):
        position = chunk * CHUNK + (CHUNK - 1 - k if GRADIENT else k)
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(values, token, limit, channel)
        vector = load_vector(vectors, batch, position, length, STATE, REVERSE)
        decay = tl.exp(step[:, None] * rate)
        if GRADIENT:
            state = decay * (state + value[:, None] * vector)
        else:
            state = decay * state + (step * value)[:, None] * vector
        total += step
    row = (batch * tl.num_programs(0) + chunk) * channels
    tl.store(states + row * STATE + entry, state, mask=there[:, None])
    tl.store(steps + row + channel, total, mask=there)


@kernel
def pass_on(
    A,
    steps,
    states,
    chunks,
    channels,
    GRADIENT: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Replace what each chunk adds by the state before it, or with GRADIENT by the gradient of the
    state after it; see `add_up`."""
    entry = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    batch = tl.program_id(1).to(tl.int64)
    size = channels * STATE
    rate = tl.load(A + entry, mask=entry < size, other=0.0)
    state = tl.zeros((BLOCK,), tl.float32)
    for start in range(0, chunks, AHEAD):
        # All loads first: they do not wait for each other.
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
