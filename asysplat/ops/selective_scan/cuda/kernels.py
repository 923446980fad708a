"""The kernels: a program takes a block of channels through a chunk of a sequence."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel, tokens_at

AHEAD = tl.constexpr(8)  # chunks that a program loads at once


@kernel
def locate(channels, STATE: tl.constexpr, BLOCK: tl.constexpr):
    """Return sequence, chunk of the segment, channels, which exist, states' places in [D, N]."""
    chunk = tl.program_id(0)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    batch = tl.program_id(2).to(tl.int64)
    entry = channel[:, None] * STATE + tl.arange(0, STATE)[None, :]
    return batch, chunk, channel, channel < channels, entry


@kernel
def row_at(batch, position, length, size, REVERSE: tl.constexpr):
    """Return the place of a token's row in [B, L, size], and its length, 0 if there is no token."""
    token, exists = tokens_at(position, length, REVERSE)
    return (batch * length + token) * size, tl.where(exists, size, 0)


@kernel
def load_channels(array, row, limit, channel):
    """Return the row's numbers at `channel` in fp32; 0 from `limit` on."""
    return tl.load(array + row + channel, mask=channel < limit, other=0.0).to(tl.float32)


@kernel
def load_projection(array, batch, position, length, STATE: tl.constexpr, REVERSE: tl.constexpr):
    """Return a token's row of an array [B, L, N] as fp32 [1, STATE]; 0 if there is no token."""
    row, limit = row_at(batch, position, length, STATE, REVERSE)
    return load_channels(array, row, limit, tl.arange(0, STATE))[None, :]


@kernel
def sum_chunk(
    values,  # x; with GRADIENT, grad_output
    dt,
    A,
    projections,  # B; with GRADIENT, C
    states,  # [B, chunks, D, N], written: what the tokens add
    steps,  # [B, chunks, D], written: the sum of dt
    first,  # position of the segment's first token
    length,
    channels,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write what a chunk's tokens add to the state, and the sum of their steps.

    With GRADIENT, this and `pass_states` go from the last chunk to the first, and through each
    chunk from its end: they pass on the gradient of the state before a token.
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
    """Replace what each chunk adds, see `sum_chunk`, by the state before the chunk.

    With GRADIENT, replace it by the gradient of the state after the chunk. `carry` [B, D, N] is the
    state before the segment, or the gradient after it; that of the other end is written.
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
    states,  # [B, chunks, D, N], before each chunk
    y,
    first,  # position of the segment's first token
    length,
    channels,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write y [B, L, D]."""
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


@kernel
def backward_chunk(
    grad_output,
    x,
    dt,
    A,
    B,
    C,
    D,
    states,  # [B, chunks, D, N], before each chunk
    grad_states,  # [B, chunks, D, N], of the states after each chunk
    grad_x,
    grad_dt,
    grad_A,  # [B, chunks, D, N]
    grad_B,  # [B, chunks * CHUNK, blocks, N], like grad_C
    grad_C,
    grad_D,  # [B, chunks, D]
    first,  # position of the segment's first token
    length,
    channels,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write the gradients for a chunk and a block of channels.

    The caller sums those of A and D over sequences and chunks, and those of B and C over blocks.
    The latter are in the order of the scan.
    """
    batch, chunk, channel, exists, entry = locate(channels, STATE, BLOCK)
    rate = tl.load(A + entry, mask=exists[:, None], other=0.0)
    skip = tl.load(D + channel, mask=exists, other=0.0)
    row = (batch * tl.num_programs(0) + chunk) * channels
    state = tl.load(states + row * STATE + entry, mask=exists[:, None], other=0.0)
    before = (state,)
    for k in tl.static_range(CHUNK - 1):
        position = first + chunk * CHUNK + k
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(x, token, limit, channel)
        projection = load_projection(B, batch, position, length, STATE, REVERSE)
        state = tl.exp(step[:, None] * rate) * state + (step * value)[:, None] * projection
        before = before + (state,)

    grad_state = tl.load(grad_states + row * STATE + entry, mask=exists[:, None], other=0.0)
    total_A = tl.zeros_like(rate)
    total_D = tl.zeros_like(skip)
    for k in tl.static_range(CHUNK):
        place = chunk * CHUNK + (CHUNK - 1 - k)
        position = first + place
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(x, token, limit, channel)
        out = load_channels(grad_output, token, limit, channel)
        projection = load_projection(B, batch, position, length, STATE, REVERSE)
        decay = tl.exp(step[:, None] * rate)
        decayed = decay * before[CHUNK - 1 - k]
        state = decayed + (step * value)[:, None] * projection
        grad_state += out[:, None] * load_projection(C, batch, position, length, STATE, REVERSE)
        grad_exponent = grad_state * decayed
        grad_input = tl.sum(grad_state * projection, 1)
        total_A += step[:, None] * grad_exponent
        total_D += value * out

        result = (step * grad_input + skip * out).to(grad_x.dtype.element_ty)
        tl.store(grad_x + token + channel, result, mask=channel < limit)
        grad_step = tl.sum(grad_exponent * rate, 1) + value * grad_input
        tl.store(grad_dt + token + channel, grad_step, mask=channel < limit)
        part = (batch * tl.num_programs(0) * CHUNK + place) * tl.num_programs(1)
        entries = (part + tl.program_id(1)) * STATE + tl.arange(0, STATE)
        tl.store(grad_B + entries, tl.sum(grad_state * (step * value)[:, None], 0))
        tl.store(grad_C + entries, tl.sum(state * out[:, None], 0))
        grad_state *= decay
    tl.store(grad_A + row * STATE + entry, total_A, mask=exists[:, None])
    tl.store(grad_D + row + channel, total_D, mask=exists)
