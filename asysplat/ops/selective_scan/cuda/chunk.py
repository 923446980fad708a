"""The indices of a program: a chunk of a sequence, and a block of its channels."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel, tokens_at


@kernel
def place(channels, STATE: tl.constexpr, BLOCK: tl.constexpr):
    """Return batch entry, chunk, channels, which of them exist, and their places in [D, N]."""
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
    """Return fp32 [BLOCK] of a row, 0 from `limit` on."""
    return tl.load(array + row + channel, mask=channel < limit, other=0.0).to(tl.float32)


@kernel
def load_projection(array, batch, position, length, STATE: tl.constexpr, REVERSE: tl.constexpr):
    """Return fp32 [1, STATE] of an array [B, L, N], 0 if there is no token."""
    row, limit = row_at(batch, position, length, STATE, REVERSE)
    return load_channels(array, row, limit, tl.arange(0, STATE))[None, :]
