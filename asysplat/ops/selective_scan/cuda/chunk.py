"""One chunk: its output from the state before it."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.selective_scan.cuda.tile import load_channels, load_vector, place, row_at


@kernel
def scan_chunk(
    x,
    dt,
    A,
    B,
    C,
    D,
    states,
    y,
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
        states: [B, chunks, D, N] before each chunk.
    """
    batch, chunk, channel, there, entry = place(channels, STATE, BLOCK)
    rate = tl.load(A + entry, mask=there[:, None], other=0.0)
    skip = tl.load(D + channel, mask=there, other=0.0)
    row = (batch * tl.num_programs(0) + chunk) * channels
    state = tl.load(states + row * STATE + entry, mask=there[:, None], other=0.0)
    for k in tl.static_range(CHUNK):
        position = chunk * CHUNK + k
        token, limit = row_at(batch, position, length, channels, REVERSE)
        step = load_channels(dt, token, limit, channel)
        value = load_channels(x, token, limit, channel)
        state = tl.exp(step[:, None] * rate) * state + (step * value)[:, None] * load_vector(
            B, batch, position, length, STATE, REVERSE
        )
        out = tl.sum(state * load_vector(C, batch, position, length, STATE, REVERSE), 1)
        out = (out + skip * value).to(y.dtype.element_ty)
        tl.store(y + token + channel, out, mask=channel < limit)
