"""One head after the other through a segment: c chunks of q tokens, l in all.

A state is [N, width], the head width in whole vectors; so is all that has a row for each token.
What lies beyond the head's width stays 0.
"""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import LANES, ONE, ZERO
from asysplat.ops.cpu.products import add_product, add_triangle, transpose
from asysplat.ops.cpu.vectors import fma, load, total, zeros
from asysplat.ops.ssd.cpu.decays import mix, unmix


@kernel
def forward_heads(start, stop, x, dt, B, C, D, scores, decays, reverse, states, y):
    """Write y [l, h, p] of heads start to stop and take their states to behind the segment.

    Args:
        x: [l, h, p].
        dt: [l, h].
        B, C: [c, q, N].
        D: [h].
        scores: [c, q, q], C B^T.
        decays: see `Decays`.
        states: [h, N, width] before the segment.
    """
    chunks, size, _ = B.shape
    head_width, width = x.shape[2], states.shape[2]
    inputs, out = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    weights = np.zeros((size, size), np.float32)
    for head in range(start, stop):
        for k in range(chunks):
            chunk = chunks - 1 - k if reverse else k
            begin = chunk * size
            take(x, begin, head, inputs)
            scale_rows(inputs, dt[begin : begin + size, head])
            mix(scores[chunk], decays.high[chunk, head], decays.low[chunk, head], reverse, weights)
            add_product(out, C[chunk], states[head], ZERO)
            scale_rows(out, decays.from_start[chunk, head])
            add_triangle(out, weights, inputs, reverse)
            for t in range(size):
                for i in range(head_width):
                    y[begin + t, head, i] = fma(D[head], x[begin + t, head, i], out[t, i])
            scale_rows(inputs, decays.to_end[chunk, head])
            add_product(states[head], B[chunk].T, inputs, decays.across[chunk, head])


@kernel
def backward_heads(
    start, stop, grad_y, x, dt, A, B, C, D, scores, decays, reverse, carried, grad_states,
    grad_x, grad_dt, grad_A, grad_D, part_B, part_C, part_scores,
):  # fmt: skip
    """Gradients, of groups start to stop of the heads.

    Args:
        grad_y, ..., reverse: as in `forward_heads`.
        carried: [h, N, width] states before the segment.
        grad_states: [h, N, width] of the states behind the segment; taken to before it.
        grad_x, grad_dt: written.
        grad_A, grad_D: [h] float64, added to.
        part_B, part_C: [c, groups, q, N in whole vectors], written, but for what scores add.
        part_scores: [c, groups, q, q], written.
    """
    chunks, size, state_size = B.shape
    heads, head_width = x.shape[1:]
    width, groups = carried.shape[2], part_B.shape[1]
    values, pull = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    inputs, grad_inputs = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    read = np.zeros((size, width), np.float32)
    inputs_T = np.zeros((width, size), np.float32)
    weights, grad_weights = np.zeros((size, size), np.float32), np.zeros((size, size), np.float32)
    states = np.empty((chunks, state_size, width), np.float32)
    state_T = np.zeros((width, part_B.shape[3]), np.float32)
    grad_logs, before, behind = np.empty(size), np.empty(size), np.empty(size)
    for group in range(start, stop):
        part_scores[:, group] = ZERO
        first, last = group * heads // groups, (group + 1) * heads // groups
        for head in range(first, last):
            grad_state = grad_states[head]
            part_of_others = ZERO if head == first else ONE

            # The state before each chunk once more.
            states[chunks - 1 if reverse else 0] = carried[head]
            for k in range(1, chunks):
                chunk, done = (chunks - 1 - k, chunks - k) if reverse else (k, k - 1)
                take(x, done * size, head, inputs)
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
                take(x, begin, head, values)
                take(grad_y, begin, head, pull)
                inputs[:] = values
                scale_rows(inputs, dt[begin : begin + size, head])

                # What the tokens see of one another.
                transpose(inputs, inputs_T)
                add_product(grad_weights, pull, inputs_T, ZERO)
                unmix(
                    grad_weights, scores[chunk], high, low, reverse,
                    part_scores[chunk, group], grad_logs,
                )  # fmt: skip
                mix(scores[chunk], high, low, reverse, weights)

                # What they add to the state behind the chunk.
                scale_rows(inputs, to_end)
                add_product(grad_inputs, B[chunk], grad_state, ZERO)
                for t in range(size):
                    before[t] = dot_rows(grad_inputs, inputs, t)
                scale_rows(grad_inputs, to_end)
                add_triangle(grad_inputs, weights.T, pull, not reverse)
                transpose(grad_state, state_T)
                add_product(part_B[chunk, group], inputs, state_T, part_of_others)

                # What is left of the state before it, and what they read of that.
                left = 0.0
                for n in range(state_size):
                    left += dot_rows(states[chunk], grad_state, n)
                add_product(read, C[chunk], states[chunk], ZERO)
                for t in range(size):
                    behind[t] = dot_rows(read, pull, t) * from_start[t]
                read[:] = pull
                scale_rows(read, from_start)
                transpose(states[chunk], state_T)
                add_product(part_C[chunk, group], read, state_T, part_of_others)
                add_product(grad_state, C[chunk].T, read, across)

                grad_logs += left * across
                add_sums(before, behind, reverse, grad_logs)
                for t in range(size):
                    step = dt[begin + t, head]
                    from_inputs = dot_rows(grad_inputs, values, t)
                    grad_dt[begin + t, head] = grad_logs[t] * A[head] + from_inputs
                    grad_A[head] += grad_logs[t] * step
                    grad_D[head] += dot_rows(pull, values, t)
                    for i in range(head_width):
                        grad_x[begin + t, head, i] = fma(
                            D[head], pull[t, i], grad_inputs[t, i] * step
                        )


@inline
def add_sums(before, behind, reverse, grad_logs):
    """A token's decay acts on what was written before it and is read at it or behind it.

    They are sums of the tokens before and behind, and no differences of sums: these would keep the
    rounding of the largest.
    """
    size = len(grad_logs)
    written = read = 0.0
    for k in range(size):
        t = size - 1 - k if reverse else k
        grad_logs[t] += written
        written += before[t]
        t = size - 1 - t
        read += behind[t]
        grad_logs[t] += read


@inline
def take(tensor, begin, head, rows):
    """Copy what [l, h, p] has of a head for a chunk's tokens."""
    for t in range(len(rows)):
        for i in range(tensor.shape[2]):
            rows[t, i] = tensor[begin + t, head, i]


@inline
def scale_rows(rows, factors):
    for t in range(len(rows)):
        for i in range(rows.shape[1]):
            rows[t, i] *= factors[t]


@inline
def dot_rows(a, b, t):
    """The product of row t of both, contiguous and in whole vectors."""
    vectors = a.shape[1] // LANES
    value = zeros()
    for i in range(t * vectors, (t + 1) * vectors):
        value = fma(load(a, i), load(b, i), value)
    return float(total(value))
