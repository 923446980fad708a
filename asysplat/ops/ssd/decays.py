"""Decays between the tokens of a chunk, on a CPU: what turns scores into weights, and back."""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import LANES, ONE, ZERO, decay2


@inline
def decay_between(high, low, chunk, head, t, s, reverse):
    """Of token s at token t: 0 where s comes later."""
    before = s >= t if reverse else s <= t
    # Sums of logarithms in two float32 each: a token that forgets everything leaves no rounding in
    # the decays behind it.
    whole = high[chunk, head, t] - high[chunk, head, s]
    exponent = whole + (low[chunk, head, t] - low[chunk, head, s])
    return decay2(min(exponent, ZERO)) * (ONE if before else ZERO)


@inline
def reach(t, size, reverse):
    """First and last token that token t sees, as whole vectors."""
    if reverse:
        return t // LANES * LANES, size
    return 0, (t // LANES + 1) * LANES


@kernel
def mix(start, stop, scores, high, low, reverse, weights):
    """Write `weights` [c, h, q, q] of c x h blocks start to stop: scores times decays.

    Args:
        scores: [c, q, q] of token t (row) and s.
        high, low: [c, h, q] log2 of the decay since the scan entered the chunk.
        reverse: tokens see those after them.
    """
    heads, size = weights.shape[1:3]
    for index in range(start, stop):
        chunk, head = index // heads, index % heads
        for t in range(size):
            first, last = reach(t, size, reverse)
            weights[chunk, head, t, :first] = ZERO
            weights[chunk, head, t, last:] = ZERO
            for base in range(first, last, LANES):
                for i in range(LANES):
                    decay = decay_between(high, low, chunk, head, t, base + i, reverse)
                    weights[chunk, head, t, base + i] = scores[chunk, t, base + i] * decay


@kernel
def unmix(start, stop, grad_weights, scores, high, low, reverse, grad_scores, grad_exponents):
    """Write the gradients of scores [c, q, q] and of each token's dt A [c, h, q], float64, of
    chunks start to stop, from that of `mix`'s weights."""
    heads, size = grad_weights.shape[1:3]
    pull = np.empty(LANES, np.float32)
    column = np.empty(size)
    for chunk in range(start, stop):
        grad_scores[chunk] = ZERO
        for head in range(heads):
            column[:] = 0
            for k in range(size):
                t = k if reverse else size - 1 - k  # from the last that the scan comes to
                first, last = reach(t, size, reverse)
                for base in range(first, last, LANES):
                    for i in range(LANES):
                        decay = decay_between(high, low, chunk, head, t, base + i, reverse)
                        pull[i] = decay * grad_weights[chunk, head, t, base + i]
                        grad_scores[chunk, t, base + i] += pull[i]
                    for i in range(LANES):
                        column[base + i] += float(pull[i] * scores[chunk, t, base + i])
                # The decay of t lies between all tokens before it and itself or those behind it.
                total = 0.0
                for s in range(t + 1 if reverse else 0, size if reverse else t):
                    total += column[s]
                grad_exponents[chunk, head, t] = total
