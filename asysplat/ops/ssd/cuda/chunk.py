"""The places of a chunk's tokens in the arrays, the decays between them, and matrix products."""

import triton.language as tl

from asysplat.kernels.triton_utils import INTERPRETED, kernel, tokens_at

IN_INTERPRETER = tl.constexpr(INTERPRETED)
# Rows of the decays, fp32 [B, H, ROWS, positions]: the log decay (<= 0) from the chunk's start,
# including the token's own; its rounding error in float32; the log decay to the chunk's end; dt.
SINCE, REST, TO_END, STEP = (tl.constexpr(row) for row in range(4))
ROWS = tl.constexpr(4)
# Least log decay of a token: its exp is 0 in float32, and sums with lesser ones are less precise.
MIN_EXPONENT = tl.constexpr(-128.0)


@kernel
def rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK):
    """Return the places [CHUNK, P] of a chunk's tokens in [B, L, H, P], and which exist."""
    token, inside = tokens_at(chunk * CHUNK + tl.arange(0, CHUNK), length, REVERSE)
    row = (batch * length + token) * heads + head
    return row[:, None] * HEAD_DIM + tl.arange(0, HEAD_DIM)[None, :], inside[:, None]


@kernel
def rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK):
    """Return the places of a chunk's tokens in BLOCK columns of [B, L, N], and which exist."""
    token, inside = tokens_at(chunk * CHUNK + tl.arange(0, CHUNK), length, REVERSE)
    row = (batch * length + token)[:, None] * STATE
    return row + first + tl.arange(0, BLOCK)[None, :], inside[:, None]


@kernel
def state_at(part, first, HEAD_DIM, STATE, BLOCK):
    """Return the places of BLOCK columns of a state, [P, BLOCK], in [B, chunks, H, P, N].

    `part` is the state's index in [B, chunks, H].
    """
    row = part * HEAD_DIM + tl.arange(0, HEAD_DIM)
    return row[:, None] * STATE + first + tl.arange(0, BLOCK)[None, :]


@kernel
def square_at(batch, chunk, chunks, CHUNK):
    """Return the places of a chunk's matrix in [B, chunks, CHUNK, CHUNK]."""
    lane = tl.arange(0, CHUNK)
    return ((batch * chunks + chunk) * CHUNK + lane)[:, None] * CHUNK + lane[None, :]


@kernel
def sum_decays(
    dt,
    A,
    decays,
    length,
    heads,
    REVERSE: tl.constexpr,
    CHUNK: tl.constexpr,
    HEADS: tl.constexpr,
):
    """Write the decays for a chunk and HEADS heads; a position without a token has dt = 0.

    Args:
        dt, A: [B, L, H] and [H].
        decays: [B, H, ROWS, positions], written.
    """
    chunk = tl.program_id(0)
    head = tl.program_id(1) * HEADS + tl.arange(0, HEADS)
    batch = tl.program_id(2).to(tl.int64)
    position = chunk * CHUNK + tl.arange(0, CHUNK)
    token, inside = tokens_at(position, length, REVERSE)
    exists = (head < heads)[:, None]
    mask = exists & inside[None, :]
    step = tl.load(
        dt + (batch * length + token)[None, :] * heads + head[:, None], mask=mask, other=0.0
    )
    rate = tl.load(A + head, mask=head < heads, other=0.0)
    exponent = tl.maximum(step.to(tl.float64) * rate.to(tl.float64)[:, None], MIN_EXPONENT)
    total = tl.cumsum(exponent, 1)
    since = total.to(tl.float32)
    positions = tl.num_programs(0) * CHUNK
    to = decays + (batch * heads + head)[:, None] * ROWS * positions + position[None, :]
    tl.store(to + SINCE * positions, since, mask=exists)
    tl.store(to + REST * positions, (total - since.to(tl.float64)).to(tl.float32), mask=exists)
    to_end = tl.sum(exponent, 1)[:, None] - total
    tl.store(to + TO_END * positions, tl.minimum(to_end, 0.0).to(tl.float32), mask=exists)
    tl.store(to + STEP * positions, step, mask=exists)


@kernel
def locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK: tl.constexpr):
    """Return the place of a chunk's first position in a head's rows, and the length of a row."""
    positions = tl.cast(chunks, tl.int64) * CHUNK
    return decays + (batch * heads + head) * ROWS * positions + chunk * CHUNK, positions


@kernel
def decay_between(row, positions, CHUNK: tl.constexpr):
    """Return [t, s], the decay from position s to position t; 0 where s is later than t."""
    lane = tl.arange(0, CHUNK)
    since = tl.load(row + SINCE * positions + lane)
    rest = tl.load(row + REST * positions + lane)
    exponent = (since[:, None] - since[None, :]) + (rest[:, None] - rest[None, :])
    decay = tl.exp(tl.minimum(exponent, 0.0))
    return tl.where(lane[:, None] >= lane[None, :], decay, 0.0)


@kernel
def product(a, b, DOT: tl.constexpr, PRECISION: tl.constexpr):
    """Return the matrix product a b, with the factors converted to DOT and sums in fp32."""
    a, b = a.to(DOT), b.to(DOT)
    if IN_INTERPRETER:  # the interpreter's products read bfloat16 as integers
        a, b = a.to(tl.float32), b.to(tl.float32)
    return tl.dot(a, b, input_precision=PRECISION)
