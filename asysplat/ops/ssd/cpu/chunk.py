"""The inputs of a segment's chunks, and the decays between their tokens, which weigh the scores."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import inline
from asysplat.kernels.simd.vectors import LANES, ONE, ZERO, decay2, fma, load, total, zeros


class Decays(NamedTuple):
    """The decays of c chunks of q tokens, for h heads; float32.

    Args:
        high, low: [c, h, q] log2 of the decay since the start of the chunk, as the sum of two
            numbers: a huge step leaves no rounding error in later decays.
        from_start: [c, h, q] decay from the start of the chunk, in scan order, to a token.
        to_end: [c, h, q] decay from a token to the end of the chunk.
        across: [c, h] decay of the whole chunk.
    """

    high: np.ndarray
    low: np.ndarray
    from_start: np.ndarray
    to_end: np.ndarray
    across: np.ndarray


class Segment(NamedTuple):
    """The inputs of a scan for c chunks of q tokens, l = c q in all; float32.

    Args:
        x: [l, h, p].
        dt: [l, h].
        A, D: [h].
        B, C: [c, q, N].
        scores: [c, q, q] products C_t . B_s of tokens t (row) and s (column).
        decays: decays within each chunk.
        reverse: True if the scan goes from the last token to the first.
    """

    x: np.ndarray
    dt: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    scores: np.ndarray
    decays: Decays
    reverse: bool


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


def sum_decays(dt: Float[Tensor, "c q h"], A: Float[Tensor, "h"], reverse: bool) -> Decays:
    """Sum the log decays in float64 along the scan, from the start of each chunk."""
    logs = (dt.double() * A.double() / math.log(2)).transpose(1, 2)
    logs = logs.flip(-1).cumsum(-1).flip(-1) if reverse else logs.cumsum(-1)
    total = logs[..., :1] if reverse else logs[..., -1:]
    high = logs.float()
    decays = (high, logs - high, logs.exp2(), (total - logs).exp2(), total.squeeze(-1).exp2())
    return Decays(*(part.float().contiguous().numpy() for part in decays))


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
    """Write the products of scores and decays to `weights`, for each token t in its `range_up_to`.

    Args:
        scores, weights: [q, q] numbers of tokens t (row) and s (column).
        high, low: [q], see `Decays`.
        reverse: True if the scan goes from the last token to the first.
    """
    size = len(scores)
    for t in range(size):
        first, last = range_up_to(t, size, reverse)
        for base in range(first, last, LANES):
            for i in range(LANES):
                decay = decay_between(high, low, t, base + i, reverse)
                weights[t, base + i] = scores[t, base + i] * decay


@inline
def weigh_scores_backward(grad_weights, scores, high, low, reverse, grad_scores, grad_logs):
    """Differentiate `weigh_scores` with respect to the scores and the log decays.

    Args:
        grad_weights, scores: [q, q].
        grad_scores: [q, q], added to.
        grad_logs: [q] float64, written: gradient of each token's dt A.
    """
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
