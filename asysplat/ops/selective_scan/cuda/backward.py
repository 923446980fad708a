"""The gradients of each chunk, from the state before it and the gradient of the state after it."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.ops.selective_scan.cuda.chunk import (
    load_channels,
    load_projection,
    locate,
    row_at,
)


@kernel
def backward_chunk(
    grad_output,
    x,
    dt,
    A,
    B,
    C,
    D,
    states,
    grad_states,
    grad_x,
    grad_dt,
    grad_A,
    grad_B,
    grad_C,
    grad_D,
    first,
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

    Args:
        grad_output, x, dt, A, B, C, D: see `asysplat.ops.selective_scan`.
        states: [B, chunks, D, N] states before each chunk.
        grad_states: [B, chunks, D, N] gradients of the states after each chunk.
        grad_x, grad_dt: [B, L, D].
        grad_A, grad_D: [B, chunks, D, N] and [B, chunks, D].
        grad_B, grad_C: [B, chunks * CHUNK, blocks, N].
        first: position of the segment's first token.
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
