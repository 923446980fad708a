"""Rows of a chunk's tokens, and their products."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.ops.cuda.scans import INTERPRETED, tokens_at

IN_INTERPRETER = tl.constexpr(INTERPRETED)


@kernel
def rows_of_head(batch, chunk, head, length, heads, WIDTH, REVERSE, CHUNK):
    """Where an array [B, L, H, P] has the tokens of a chunk, [CHUNK, P], and which are there."""
    token, inside = tokens_at(chunk * CHUNK + tl.arange(0, CHUNK), length, REVERSE)
    row = (batch * length + token) * heads + head
    return row[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :], inside[:, None]


@kernel
def rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK):
    """Where an array [B, L, N] has BLOCK columns of a chunk's tokens, and which are there."""
    token, inside = tokens_at(chunk * CHUNK + tl.arange(0, CHUNK), length, REVERSE)
    row = (batch * length + token)[:, None] * STATE
    return row + first + tl.arange(0, BLOCK)[None, :], inside[:, None]


@kernel
def state_at(batch, chunk, chunks, head, heads, first, WIDTH, STATE, BLOCK):
    """Where states [B, chunks, H, P, N] have BLOCK columns of a chunk's, [P, BLOCK]."""
    row = ((batch * chunks + chunk) * heads + head) * WIDTH + tl.arange(0, WIDTH)
    return row[:, None] * STATE + first + tl.arange(0, BLOCK)[None, :]


@kernel
def square_at(batch, chunk, chunks, CHUNK):
    """Where an array [B, chunks, CHUNK, CHUNK] has a chunk's."""
    lane = tl.arange(0, CHUNK)
    return ((batch * chunks + chunk) * CHUNK + lane)[:, None] * CHUNK + lane[None, :]


@kernel
def product(a, b, DOT: tl.constexpr, PRECISION: tl.constexpr):
    """a @ b, the factors as DOT, summed in fp32."""
    a, b = a.to(DOT), b.to(DOT)
    if IN_INTERPRETER:  # whose products take bfloat16 for integers
        a, b = a.to(tl.float32), b.to(tl.float32)
    return tl.dot(a, b, input_precision=PRECISION)
