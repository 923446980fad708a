"""The indices of a program, which takes a block of channels through a chunk of a sequence."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel, tokens_at


@kernel
def locate(channels, STATE: tl.constexpr, BLOCK: tl.constexpr):
    """Return sequence, chunk of the segment, channels, which exist, their states' places in [D, N].

    Shapes: scalars, [BLOCK], [BLOCK], [BLOCK, STATE].
    """
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
