"""The gradients of a segment: each head goes through its chunks, last chunk first.

`width` is the head_dim in whole vectors of LANES, as in the forward pass.
"""

from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.products import add_product, add_triangle, transpose
from asysplat.kernels.simd.threads import inline, kernel
from asysplat.kernels.simd.vectors import ONE, ZERO, fma
from asysplat.ops.ssd.cpu.chunk import (
    dot_rows,
    scale_rows,
    take_rows,
    weigh_scores,
    weigh_scores_backward,
)


class HeadGradients(NamedTuple):
    """The gradients of the inputs of each head.

    Args:
        x, dt: [l, h, p] and [l, h] float32, written.
        A, D: [h] float64, added to.
    """

    x: np.ndarray
    dt: np.ndarray
    A: np.ndarray
    D: np.ndarray


class GroupGradients(NamedTuple):
    """The gradients of the shared inputs, summed over each group of heads; float32, written.

    Args:
        B, C: [c, groups, q, N in whole vectors], without the part through the scores.
        scores: [c, groups, q, q].
    """

    B: np.ndarray
    C: np.ndarray
    scores: np.ndarray


@kernel
def backward_heads(
    start, stop, segment, saved_state, grad_output, grad_states, head_grads, group_grads
):
    """Write the gradients for the groups of heads from start to stop.

    Args:
        segment: see `Segment`.
        saved_state: [h, N, width] states before the segment.
        grad_output: [l, h, p].
        grad_states: [h, N, width] gradients of the states after the segment, overwritten by those
            of the states before it.
        head_grads, group_grads: see `HeadGradients` and `GroupGradients`.
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
    and later tokens read from the state before the chunk. Both are summed directly: differences of
    sums would keep the rounding error of the largest.

    Args:
        before: [q], what each token writes times its gradient.
        after: [q], what each token reads times its gradient.
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
