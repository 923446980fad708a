"""The kernels: a program takes a head, or a part of the shared state, through a chunk."""

import triton.language as tl

from asysplat.kernels.triton_utils import INTERPRETED, kernel, tokens_at

IN_INTERPRETER = tl.constexpr(INTERPRETED)
# Rows of all `decays`, fp32 [B, H, ROWS, positions]: the log decay (<= 0) from the chunk's start,
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
    """Return the places of BLOCK columns of state `part`, [P, BLOCK], in [B x chunks x H, P, N]."""
    row = part * HEAD_DIM + tl.arange(0, HEAD_DIM)
    return row[:, None] * STATE + first + tl.arange(0, BLOCK)[None, :]


@kernel
def square_at(batch, chunk, chunks, CHUNK):
    """Return the places of a chunk's matrix in [B, chunks, CHUNK, CHUNK]."""
    lane = tl.arange(0, CHUNK)
    return ((batch * chunks + chunk) * CHUNK + lane)[:, None] * CHUNK + lane[None, :]


@kernel
def sum_decays(
    dt, A, decays, length, heads, REVERSE: tl.constexpr, CHUNK: tl.constexpr, HEADS: tl.constexpr
):
    """Write the decays for a chunk and HEADS heads; a position without a token has dt = 0."""
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


@kernel
def pass_states(
    values,  # x; with GRADIENT, grad_output
    projections,  # B; with GRADIENT, C
    decays,
    states,
    length,
    heads,
    chunks,
    GRADIENT: tl.constexpr,
    REVERSE: tl.constexpr,
    HEAD_DIM: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Pass BLOCK columns of a head's state from chunk to chunk; with GRADIENT, from last to first.

    Written to `states` [B, chunks, H, P, N] is the state before each chunk, or with GRADIENT the
    gradient of the state after it. What is passed on is in fp32.
    """
    first, head = tl.program_id(0) * BLOCK, tl.program_id(1)
    batch = tl.program_id(2).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    state = tl.zeros((HEAD_DIM, BLOCK), tl.float32)
    for k in range(chunks):
        chunk = chunks - 1 - k if GRADIENT else k
        part = (batch * chunks + chunk) * heads + head
        at = state_at(part, first, HEAD_DIM, STATE, BLOCK)
        tl.store(states + at, state.to(states.dtype.element_ty))
        row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
        if GRADIENT:
            weight = tl.exp(tl.load(row + SINCE * positions + lane))
        else:
            weight = tl.exp(tl.load(row + TO_END * positions + lane))
            weight *= tl.load(row + STEP * positions + lane)
        at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
        value = tl.load(values + at, mask=inside, other=0.0).to(tl.float32) * weight[:, None]
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        projection = tl.load(projections + at, mask=inside, other=0.0)
        decay = tl.exp(tl.load(row + SINCE * positions + CHUNK - 1))
        state = decay * state + product(tl.trans(value), projection, DOT, PRECISION)


@kernel
def score_chunk(
    B,
    C,
    scores,
    length,
    chunks,
    REVERSE: tl.constexpr,
    STATE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    DOT: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write the scores C_t . B_s, [B, chunks, t, s] fp32, shared by all heads."""
    chunk, batch = tl.program_id(0), tl.program_id(1).to(tl.int64)
    total = tl.zeros((CHUNK, CHUNK), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        b = tl.load(B + at, mask=inside, other=0.0)
        c = tl.load(C + at, mask=inside, other=0.0)
        total += product(c, tl.trans(b), DOT, PRECISION)
    tl.store(scores + square_at(batch, chunk, chunks, CHUNK), total)


@kernel
def forward_chunk(
    x,
    C,
    D,
    decays,
    scores,
    states,
    y,
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
    """Write y [B, L, H, P] of a chunk and a head."""
    chunk, head = tl.program_id(0) // heads, tl.program_id(0) % heads
    batch = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, CHUNK)
    row, positions = locate_decays(decays, batch, head, heads, chunk, chunks, CHUNK)
    part = (batch * chunks + chunk) * heads + head
    total = tl.zeros((CHUNK, HEAD_DIM), tl.float32)
    for first in range(0, STATE, BLOCK):
        at, inside = rows_of_state(batch, chunk, first, length, STATE, BLOCK, REVERSE, CHUNK)
        c = tl.load(C + at, mask=inside, other=0.0)
        at = state_at(part, first, HEAD_DIM, STATE, BLOCK)
        total += product(c, tl.trans(tl.load(states + at)), DOT, PRECISION)
    total *= tl.exp(tl.load(row + SINCE * positions + lane))[:, None]

    at, inside = rows_of_head(batch, chunk, head, length, heads, HEAD_DIM, REVERSE, CHUNK)
    value = tl.load(x + at, mask=inside, other=0.0)
    weight = tl.load(scores + square_at(batch, chunk, chunks, CHUNK))
    weight *= decay_between(row, positions, CHUNK)
    weight *= tl.load(row + STEP * positions + lane)[None, :]
    total += product(weight, value, DOT, PRECISION)
    total += tl.load(D + head) * value.to(tl.float32)
    tl.store(y + at, total.to(y.dtype.element_ty), mask=inside)


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
    states,  # before each chunk
    grad_states,  # gradients of the states after each chunk
    grad_x,
    grad_dt,
    grad_A,  # [B, chunks, H], to be summed over sequences and chunks, like grad_D
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
        through += tl.sum(state.to(tl.float32) * grad_state.to(tl.float32), 1)
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
    """Write the gradient of the scores C_t . B_s, [B, chunks, t, s] fp32, summed over the heads."""
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
    values,  # for B (OF_B), x; for C, grad_output
    projections,  # for B, C; for C, B
    decays,
    grad_scores,
    states,  # for B, the gradients of the states after each chunk; for C, the states before it
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
    """Write BLOCK columns of the gradient of B or C, [B, L, N]; heads are summed in their order."""
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
