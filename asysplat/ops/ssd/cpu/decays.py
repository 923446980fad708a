"""Decays between the tokens of a chunk: what turns scores into weights, and back."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.cpu.kernel import inline
from asysplat.ops.cpu.lanes import LANES, ONE, ZERO, decay2


class Decays(NamedTuple):
    """Of c chunks of q tokens, for h heads; float32.

    Args:
        high, low: [c, h, q] log2 of the decay since the scan entered the chunk, in two numbers: a
            token that forgets everything leaves no rounding in the decays behind it.
        from_start: [c, h, q] from where the scan enters the chunk to a token.
        to_end: [c, h, q] from a token to where the scan leaves the chunk.
        across: [c, h] of the whole chunk.
    """

    high: np.ndarray
    low: np.ndarray
    from_start: np.ndarray
    to_end: np.ndarray
    across: np.ndarray


def find_decays(dt: Float[Tensor, "c q h"], A: Float[Tensor, "h"], reverse: bool) -> Decays:
    logs = (dt.double() * A.double() / math.log(2)).transpose(1, 2)
    logs = logs.flip(-1).cumsum(-1).flip(-1) if reverse else logs.cumsum(-1)
    total = logs[..., :1] if reverse else logs[..., -1:]
    high = logs.float()
    decays = (high, logs - high, logs.exp2(), (total - logs).exp2(), total.squeeze(-1).exp2())
    return Decays(*(part.float().contiguous().numpy() for part in decays))


@inline
def decay_between(high, low, t, s, reverse):
    """Of token s at token t: 0 where s comes later."""
    before = s >= t if reverse else s <= t
    exponent = (high[t] - high[s]) + (low[t] - low[s])
    return decay2(min(exponent, ZERO)) * (ONE if before else ZERO)


@inline
def reach(t, size, reverse):
    """First and last token that token t sees, as whole vectors."""
    if reverse:
        return t // LANES * LANES, size
    return 0, (t // LANES + 1) * LANES


@inline
def mix(scores, high, low, reverse, weights):
    """Write `weights` [q, q], scores times decays, as far as the tokens' `reach`.

    Args:
        scores: [q, q] of token t (row) and s.
        high, low: [q], see `Decays`.
        reverse: tokens see those after them.
    """
    size = len(scores)
    for t in range(size):
        first, last = reach(t, size, reverse)
        for base in range(first, last, LANES):
            for i in range(LANES):
                decay = decay_between(high, low, t, base + i, reverse)
                weights[t, base + i] = scores[t, base + i] * decay


@inline
def unmix(grad_weights, scores, high, low, reverse, grad_scores, grad_logs):
    """Add to the gradient of scores and write that of each token's dt A [q], float64, from the
    gradient of `mix`'s weights."""
    size = len(scores)
    pull = np.empty(LANES, np.float32)
    column = np.zeros(size)
    for k in range(size):
        t = k if reverse else size - 1 - k  # from the last that the scan comes to
        first, last = reach(t, size, reverse)
        for base in range(first, last, LANES):
            for i in range(LANES):
                decay = decay_between(high, low, t, base + i, reverse)
                pull[i] = decay * grad_weights[t, base + i]
                grad_scores[t, base + i] += pull[i]
            for i in range(LANES):
                column[base + i] += float(pull[i] * scores[t, base + i])
        # The decay of t lies between all tokens before it and itself or those behind it.
        total = 0.0
        for s in range(t + 1 if reverse else 0, size if reverse else t):
            total += column[s]
        grad_logs[t] = total
