"""The kernels: each head goes through the chunks of a segment.

A state is [N, width], where `width` is the head_dim in whole vectors of LANES; arrays with a row
for each token have the same width. The columns beyond the head_dim stay 0.
"""

from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.products import add_product, add_triangle, transpose
from asysplat.kernels.simd.threads import inline, kernel
from asysplat.kernels.simd.vectors import LANES, ONE, ZERO, decay2, fma, load, total, zeros


class Decays(NamedTuple):
    """The decays of c chunks of q tokens, for h heads; float32.

    log2 of the decay since the start of the chunk is the sum of two numbers, `high` and `low`, so
    that a huge step leaves no rounding error in later decays.
    """

    high: np.ndarray  # [c, h, q]
    low: np.ndarray  # [c, h, q]
    from_start: np.ndarray  # [c, h, q], from the start of the chunk, in scan order, to a token
    to_end: np.ndarray  # [c, h, q], from a token to the end of the chunk
    across: np.ndarray  # [c, h], of the whole chunk


class Segment(NamedTuple):
    """The inputs of a scan for c chunks of q tokens, l = c q in all; float32."""

    x: np.ndarray  # [l, h, p]
    dt: np.ndarray  # [l, h]
    A: np.ndarray  # [h]
    B: np.ndarray  # [c, q, N]
    C: np.ndarray  # [c, q, N]
    D: np.ndarray  # [h]
    scores: np.ndarray  # [c, q, q] products C_t . B_s of tokens t (row) and s (column)
    decays: Decays
    reverse: bool  # from the last token to the first


@inline
def take_rows(tensor, begin, head, rows):
    """Copy a head's values of `tensor` [l, h, p] to `rows`, from token `begin` on."""
    for t in range(len(rows)):
        for i in range(tensor.shape[2]):
            rows[t, i] = tensor[begin + t, head, i]


@inline
def scale_rows(rows, factors):
    """Multiply each row by its factor, in place."""
    for t in range(len(rows)):
        for i in range(rows.shape[1]):
            rows[t, i] *= factors[t]


@inline
def dot_rows(a, b, t):
    """Return the dot product of row t of `a` and of `b`, contiguous arrays of whole vectors."""
    vectors = a.shape[1] // LANES
    value = zeros()
    for i in range(t * vectors, (t + 1) * vectors):
        value = fma(load(a, i), load(b, i), value)
    return float(total(value))


@inline
def decay_between(high, low, t, s, reverse):
    """Return the decay from token s to token t, 0 where s comes later (high, low: see `Decays`)."""
    before = s >= t if reverse else s <= t
    exponent = (high[t] - high[s]) + (low[t] - low[s])
    return decay2(min(exponent, ZERO)) * (ONE if before else ZERO)


@inline
def range_up_to(t, size, reverse):
    """Return the range of the tokens up to t in scan order, widened to whole vectors."""
    if reverse:
        return t // LANES * LANES, size
    return 0, (t // LANES + 1) * LANES


@inline
def weigh_scores(scores, high, low, reverse, weights):
    """Write the products of scores and decays, [t, s], for each token t and its `range_up_to`."""
    size = len(scores)
    for t in range(size):
        first, last = range_up_to(t, size, reverse)
        for base in range(first, last, LANES):
            for i in range(LANES):
                decay = decay_between(high, low, t, base + i, reverse)
                weights[t, base + i] = scores[t, base + i] * decay


@inline
def weigh_scores_backward(grad_weights, scores, high, low, reverse, grad_scores, grad_logs):
    """Differentiate `weigh_scores`: add to `grad_scores`, write `grad_logs`, that of dt A."""
    size = len(scores)
    grads = np.empty(LANES, np.float32)
    column = np.zeros(size)
    for k in range(size):
        t = k if reverse else size - 1 - k  # from the last in scan order
        first, last = range_up_to(t, size, reverse)
        for base in range(first, last, LANES):
            for i in range(LANES):
                decay = decay_between(high, low, t, base + i, reverse)
                grads[i] = decay * grad_weights[t, base + i]
                grad_scores[t, base + i] += grads[i]
            for i in range(LANES):
                column[base + i] += float(grads[i] * scores[t, base + i])
        # The decay of t is part of every decay from an earlier token to t or to a later token.
        total = 0.0
        for s in range(t + 1 if reverse else 0, size if reverse else t):
            total += column[s]
        grad_logs[t] = total


@kernel
def forward_heads(start, stop, segment, states, y):
    """Write y of the heads start to stop; states before the segment become those after it."""
    x, dt, B, C, D = segment.x, segment.dt, segment.B, segment.C, segment.D
    scores, decays, reverse = segment.scores, segment.decays, segment.reverse
    chunks, size, _ = B.shape
    head_dim, width = x.shape[2], states.shape[2]
    inputs, out = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    weights = np.zeros((size, size), np.float32)
    for head in range(start, stop):
        for k in range(chunks):
            chunk = chunks - 1 - k if reverse else k
            begin = chunk * size
            high, low = decays.high[chunk, head], decays.low[chunk, head]
            take_rows(x, begin, head, inputs)
            scale_rows(inputs, dt[begin : begin + size, head])
            weigh_scores(scores[chunk], high, low, reverse, weights)
            add_product(out, C[chunk], states[head], ZERO)
            scale_rows(out, decays.from_start[chunk, head])
            add_triangle(out, weights, inputs, reverse)
            for t in range(size):
                for i in range(head_dim):
                    y[begin + t, head, i] = fma(D[head], x[begin + t, head, i], out[t, i])
            scale_rows(inputs, decays.to_end[chunk, head])
            add_product(states[head], B[chunk].T, inputs, decays.across[chunk, head])


class HeadGradients(NamedTuple):
    """The gradients of the inputs of each head."""

    x: np.ndarray  # [l, h, p] float32, written
    dt: np.ndarray  # [l, h] float32, written
    A: np.ndarray  # [h] float64, added to
    D: np.ndarray  # [h] float64, added to


class GroupGradients(NamedTuple):
    """The gradients of the shared inputs, summed over each group of heads; float32, written."""

    B: np.ndarray  # [c, groups, q, N in whole vectors], without the part through the scores
    C: np.ndarray  # likewise
    scores: np.ndarray  # [c, groups, q, q]


@kernel
def backward_heads(
    start, stop, segment, saved_state, grad_output, grad_states, head_grads, group_grads
):
    """Write the gradients for the groups of heads from start to stop, last chunk first.

    `saved_state` has the states before the segment. `grad_states`, the gradients of those after it,
    are overwritten by those of the states before it.
    """
    x, dt, A, B, C, D = segment.x, segment.dt, segment.A, segment.B, segment.C, segment.D
    scores, decays, reverse = segment.scores, segment.decays, segment.reverse
    grad_x, grad_dt, grad_A, grad_D = head_grads.x, head_grads.dt, head_grads.A, head_grads.D
    part_B, part_C, part_scores = group_grads.B, group_grads.C, group_grads.scores
    chunks, size, state_size = B.shape
    heads, head_dim = x.shape[1:]
    width, groups = saved_state.shape[2], part_B.shape[1]
    values, grads = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    inputs, grad_inputs = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    read = np.zeros((size, width), np.float32)
    inputs_T = np.zeros((width, size), np.float32)
    weights, grad_weights = np.zeros((size, size), np.float32), np.zeros((size, size), np.float32)
    states = np.empty((chunks, state_size, width), np.float32)
    state_T = np.zeros((width, part_B.shape[3]), np.float32)
    grad_logs, before, after = np.empty(size), np.empty(size), np.empty(size)
    for group in range(start, stop):
        part_scores[:, group] = ZERO
        first, last = group * heads // groups, (group + 1) * heads // groups
        for head in range(first, last):
            grad_state = grad_states[head]
            part_of_others = ZERO if head == first else ONE

            # Compute the state before each chunk again.
            states[chunks - 1 if reverse else 0] = saved_state[head]
            for k in range(1, chunks):
                chunk, done = (chunks - 1 - k, chunks - k) if reverse else (k, k - 1)
                take_rows(x, done * size, head, inputs)
                scale_rows(inputs, dt[done * size : (done + 1) * size, head])
                scale_rows(inputs, decays.to_end[done, head])
                states[chunk] = states[done]
                add_product(states[chunk], B[done].T, inputs, decays.across[done, head])

            for k in range(chunks):
                chunk = k if reverse else chunks - 1 - k
                begin = chunk * size
                high, low = decays.high[chunk, head], decays.low[chunk, head]
                from_start, to_end = decays.from_start[chunk, head], decays.to_end[chunk, head]
                across = decays.across[chunk, head]
                take_rows(x, begin, head, values)
                take_rows(grad_output, begin, head, grads)
                inputs[:] = values
                scale_rows(inputs, dt[begin : begin + size, head])

                # Gradients through the scores, within the chunk.
                transpose(inputs, inputs_T)
                add_product(grad_weights, grads, inputs_T, ZERO)
                grad_scores = part_scores[chunk, group]
                weigh_scores_backward(
                    grad_weights, scores[chunk], high, low, reverse, grad_scores, grad_logs
                )
                weigh_scores(scores[chunk], high, low, reverse, weights)

                # Gradients through the state after the chunk.
                scale_rows(inputs, to_end)
                add_product(grad_inputs, B[chunk], grad_state, ZERO)
                for t in range(size):
                    before[t] = dot_rows(grad_inputs, inputs, t)
                scale_rows(grad_inputs, to_end)
                add_triangle(grad_inputs, weights.T, grads, not reverse)
                transpose(grad_state, state_T)
                add_product(part_B[chunk, group], inputs, state_T, part_of_others)

                # Gradients through the state before the chunk: what of it remains after the chunk,
                # and what the tokens read of it.
                remaining = 0.0
                for n in range(state_size):
                    remaining += dot_rows(states[chunk], grad_state, n)
                add_product(read, C[chunk], states[chunk], ZERO)
                for t in range(size):
                    after[t] = dot_rows(read, grads, t) * from_start[t]
                read[:] = grads
                scale_rows(read, from_start)
                transpose(states[chunk], state_T)
                add_product(part_C[chunk, group], read, state_T, part_of_others)
                add_product(grad_state, C[chunk].T, read, across)

                grad_logs += remaining * across
                add_sums(before, after, reverse, grad_logs)
                for t in range(size):
                    step = dt[begin + t, head]
                    from_inputs = dot_rows(grad_inputs, values, t)
                    grad_dt[begin + t, head] = grad_logs[t] * A[head] + from_inputs
                    grad_A[head] += grad_logs[t] * step
                    grad_D[head] += dot_rows(grads, values, t)
                    for i in range(head_dim):
                        grad_x[begin + t, head, i] = fma(
                            D[head], grads[t, i], grad_inputs[t, i] * step
                        )


@inline
def add_sums(before, after, reverse, grad_logs):
    """Add the gradients through the states to those of each token's log decay.

    A token's decay acts on what earlier tokens write to the state after the chunk, and on what it
    and later tokens read from the state before the chunk. `before` and `after` have what each token
    writes and reads, times its gradient. Both are summed directly: differences of sums would keep
    the rounding error of the largest.
    """
    size = len(grad_logs)
    written = read = 0.0
    for k in range(size):
        t = size - 1 - k if reverse else k
        grad_logs[t] += written
        written += before[t]
        t = size - 1 - t
        read += after[t]
        grad_logs[t] += read
