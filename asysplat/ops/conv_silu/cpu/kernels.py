"""The kernels: a task takes its bands of tokens one token after the other."""

import math
from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.threads import inline, kernel
from asysplat.kernels.simd.vectors import LANES, ONE, ZERO, exp2, fma, load_some, store_some

BAND = 128  # tokens of a band
MINUS_LOG2_E = np.float32(-1 / math.log(2))
LARGEST = np.float32(126)  # exponent that `exp2` takes


class Sequences(NamedTuple):
    """Tokens [B, L, C] in float32, where they lie in memory, or the gradient of the output."""

    numbers: np.ndarray  # from the first channel of the first token on
    length: int
    channels: int
    sequence_stride: int  # numbers from a sequence to the next
    stride: int  # numbers from a token to the next


class Taps(NamedTuple):
    """The parameters of a convolution."""

    weight: tuple[np.ndarray, ...]  # K of [C]: a loop over a tuple is unrolled
    bias: np.ndarray  # [C]
    before: int


@kernel
def forward_bands(start, stop, tokens, taps, y):
    """Write y, [B * L * C], of the bands start to stop, counted over [B, bands of a sequence]."""
    length, channels = tokens.length, tokens.channels
    bands = -(-length // BAND)
    for band in range(start, stop):
        batch, first = band // bands, band % bands * BAND
        for t in range(first, min(first + BAND, length)):
            place = (batch * length + t) * channels
            for c in range(0, channels, LANES):
                count = min(LANES, channels - c)
                x = _convolve(tokens, batch, t, taps, c, count)
                store_some(y, place + c, count, x / (ONE + _exp_minus(x)))


@kernel
def backward_bands(start, stop, tokens, grad_output, taps, grad_tokens, parts):
    """Write the gradient of the tokens, [B * L * C], of the same bands as `forward_bands`.

    `parts`, [bands, (K + 1) * C], receives each band's part of the gradients of the weights and,
    in its last row, of the bias.
    """
    length, channels, size = tokens.length, tokens.channels, len(taps.weight)
    bands = -(-length // BAND)
    for band in range(start, stop):
        batch, first = band // bands, band % bands * BAND
        last = min(first + BAND, length)
        part = parts[band]
        part[:] = ZERO
        for t in range(first + taps.before - (size - 1), last + taps.before):
            for c in range(0, channels, LANES):
                count = min(LANES, channels - c)
                x = _convolve(tokens, batch, t, taps, c, count)
                sigmoid = ONE / (ONE + _exp_minus(x))
                g = _load_token(grad_output, batch, t, c, count)
                g = g * sigmoid * fma(x, ONE - sigmoid, ONE)
                if first <= t < last:
                    for k in range(size):
                        token = _load_token(tokens, batch, t - taps.before + k, c, count)
                        _add(part, k * channels + c, count, g * token)
                    _add(part, size * channels + c, count, g)
                for k in range(size):
                    s = t - taps.before + k
                    own = count if first <= s < last else 0
                    place = (batch * length + s) * channels + c
                    # Token t is the first that reaches s with its last weight.
                    total = load_some(grad_tokens, place, own if k < size - 1 else 0)
                    w = load_some(taps.weight[k], c, count)
                    store_some(grad_tokens, place, own, fma(w, g, total))


@inline
def _load_token(sequences, batch, t, c, count):
    """Load `count` channels of a token from channel c on; they are 0 beyond the sequence's ends."""
    first = batch * sequences.sequence_stride + t * sequences.stride + c
    return load_some(sequences.numbers, first, count if 0 <= t < sequences.length else 0)


@inline
def _convolve(tokens, batch, t, taps, c, count):
    """Return `count` channels of the convolution of token t from channel c on."""
    x = load_some(taps.bias, c, count)
    for k in range(len(taps.weight)):
        token = _load_token(tokens, batch, t - taps.before + k, c, count)
        x = fma(load_some(taps.weight[k], c, count), token, x)
    return x


@inline
def _exp_minus(x):
    """Compute exp(-x) for x from -87 to 87, and its value at the nearest of these beyond them."""
    return exp2(max(min(x * MINUS_LOG2_E, LARGEST), ZERO - LARGEST))


@inline
def _add(numbers, first, count, value):
    store_some(numbers, first, count, load_some(numbers, first, count) + value)
