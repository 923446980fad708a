"""The loss and its gradient for CPUs (Numba) in one pass: a task takes bands of a channel's rows.

Let s = x + y be the sum of both images and d = x - y their difference, with means S and D and
variances V and U in a window. Then SSIM is

    (1 - D^2 / P) (1 - U / Q),  P = (S^2 + D^2) / 2 + C1,  Q = (V + U) / 2 + C2.

No difference of nearly equal numbers is taken where the images are alike, nor for a variance, which
is the mean of the variances within the window's columns plus the variance of the columns' means.
The gradient of 1 - SSIM at a pixel is a + b d + c s, where a, b and c are sums over the windows
that contain the pixel; each window's terms follow from its S, D, V and U.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import even_bounds, inline, kernel, run_blocks
from asysplat.kernels.simd.vectors import (
    LANES,
    ONE,
    ZERO,
    fma,
    less,
    load_some,
    store_some,
    total,
    where,
    zeros,
)
from asysplat.ops.image_loss import reference
from asysplat.ops.image_loss.reference import SIZE, window_weights

BAND = 64  # rows of a band; their gradients also need the windows that begin above the band
REACH = SIZE - 1  # rows below the top row of a window
WINDOW = window_weights().float().numpy()
C1, C2 = np.float32(reference.C1), np.float32(reference.C2)
HALF, TWO = np.float32(0.5), np.float32(2)


class ImagePair(NamedTuple):
    """The pairs of images, both [channels of all images, H, W]."""

    rendered: np.ndarray
    target: np.ndarray


class Weights(NamedTuple):
    """The weights in the loss of each pixel's |d| and of each window's 1 - SSIM."""

    pixel: np.float32
    window: np.float32


class Statistics(NamedTuple):
    """Means and variances of s and d, [width], over the columns of SIZE pixels of a window row."""

    mean_s: np.ndarray
    mean_d: np.ndarray
    variance_s: np.ndarray
    variance_d: np.ndarray


class Factors(NamedTuple):
    """The terms of a row of windows in a, b and c, [width], or their sums, [rows, width]."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray


def compare_images(
    rendered: Float[Tensor, "*batch 3 H W"],
    target: Float[Tensor, "*batch 3 H W"],
    weights: tuple[float, float],
    keep: bool,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3 H W"] | None]:
    """Compute the loss in float32 and, if `keep`, its gradient; see `asysplat.ops.image_loss`.

    For `weights`, see `reference.loss_weights`.
    """
    *batch, _, H, W = rendered.shape
    per_pixel, per_window = weights
    images = ImagePair(*(tensor.view(-1, H, W).numpy() for tensor in (rendered, target)))
    gradient = torch.empty_like(rendered) if keep else None
    sums = torch.empty(len(images.target) * -(-H // BAND), 2, dtype=torch.float64)
    run_blocks(
        compare_bands,
        even_bounds(len(sums)),
        images,
        Weights(np.float32(per_pixel), np.float32(per_window)),
        sums.numpy(),
        None if gradient is None else gradient.view(-1, H, W).numpy(),
    )
    error, dissimilarity = sums.view(*batch, -1, 2).sum(-2).unbind(-1)
    return (per_pixel * error + per_window * dissimilarity).float(), gradient


@kernel
def compare_bands(start, stop, images, weights, sums, gradient):
    """Compare the bands start to stop, counted over [channels of all images, bands of a channel].

    `sums` [bands, 2] receives the sum of |d| over a band's pixels, and that of 1 - SSIM over the
    windows that begin in the band; `gradient`, unless None, that of the loss.
    """
    _, H, W = images.rendered.shape
    bands = -(-H // BAND)
    windows = H - REACH if weights.window > ZERO else 0  # rows of windows
    above = REACH if gradient is not None else 0  # rows of windows that reach into a band
    width = -(-W // LANES) * LANES
    # Pixels beyond the image, and windows not wholly inside it, are zeros.
    padded = np.zeros((7, width + LANES), np.float32)
    columns = Statistics(padded[0], padded[1], padded[2], padded[3])
    factors = Factors(padded[4], padded[5], padded[6])
    rows = np.zeros((3, BAND + above, width), np.float32)
    row_sums = Factors(rows[0], rows[1], rows[2])
    for band in range(start, stop):
        plane, top = band // bands, band % bands * BAND
        bottom = min(top + BAND, H)
        error = dissimilarity = 0.0
        for y in range(top - above, bottom):
            row, inside = y - (top - above), 0 <= y < windows
            if inside:
                _compare_columns(columns, images, (plane * H + y) * W)
                of_row = _compare_windows(factors, columns, W - REACH)
                dissimilarity += of_row if y >= top else 0.0
            if gradient is not None and inside:
                _sum_along_row(row_sums, row, factors)
            elif gradient is not None:
                rows[:, row] = ZERO
        for y in range(top, bottom):
            error += _finish_row(gradient, row_sums, y - top, images, (plane * H + y) * W, weights)
        sums[band, 0], sums[band, 1] = error, dissimilarity


@inline
def _compare_columns(columns, images, first):
    """Write the statistics of the columns of SIZE pixels from the image row at `first` down."""
    W = images.rendered.shape[2]
    for x in range(0, W, LANES):
        count = min(LANES, W - x)
        mean_s, mean_d = zeros(), zeros()
        for k in range(SIZE):
            rendered = load_some(images.rendered, first + k * W + x, count)
            target = load_some(images.target, first + k * W + x, count)
            mean_s = fma(WINDOW[k], rendered + target, mean_s)
            mean_d = fma(WINDOW[k], rendered - target, mean_d)
        variance_s, variance_d = zeros(), zeros()
        for k in range(SIZE):
            rendered = load_some(images.rendered, first + k * W + x, count)
            target = load_some(images.target, first + k * W + x, count)
            s, d = (rendered + target) - mean_s, (rendered - target) - mean_d
            variance_s = fma(WINDOW[k] * s, s, variance_s)
            variance_d = fma(WINDOW[k] * d, d, variance_d)
        store_some(columns.mean_s, x, LANES, mean_s)
        store_some(columns.mean_d, x, LANES, mean_d)
        store_some(columns.variance_s, x, LANES, variance_s)
        store_some(columns.variance_d, x, LANES, variance_d)


@inline
def _compare_windows(factors, columns, w):
    """Write the factors of a row of `w` windows; return the sum of their 1 - SSIM."""
    dissimilarity = zeros()
    for x in range(0, w, LANES):
        S, D = zeros(), zeros()
        for k in range(SIZE):
            S = fma(WINDOW[k], load_some(columns.mean_s, x + k, LANES), S)
            D = fma(WINDOW[k], load_some(columns.mean_d, x + k, LANES), D)
        V, U = zeros(), zeros()
        for k in range(SIZE):
            s = load_some(columns.mean_s, x + k, LANES) - S
            d = load_some(columns.mean_d, x + k, LANES) - D
            V = fma(WINDOW[k], fma(s, s, load_some(columns.variance_s, x + k, LANES)), V)
            U = fma(WINDOW[k], fma(d, d, load_some(columns.variance_d, x + k, LANES)), U)
        over_P = ONE / fma(HALF, fma(S, S, D * D), C1)
        over_Q = ONE / fma(HALF, V + U, C2)
        D_over_P, U_over_Q = D * over_P, U * over_Q
        means, rest = ONE - D * D_over_P, ONE - U_over_Q
        count = min(LANES, w - x)
        unlike = fma(U_over_Q, means, D * D_over_P)
        dissimilarity = dissimilarity + where(np.uint16((1 << count) - 1), unlike, zeros())
        c = means * U_over_Q * over_Q
        b = fma(TWO * means, over_Q, ZERO - c)
        a = rest * D_over_P * (TWO - (S + D) * D_over_P) + (c * S - b * D)
        store_some(factors.a, REACH + x, count, a)
        store_some(factors.b, REACH + x, count, b)
        store_some(factors.c, REACH + x, count, ZERO - c)
    return total(dissimilarity)


@inline
def _sum_along_row(sums, row, factors):
    """Write the weighted sums of the factors over the windows of a row that contain each pixel."""
    width = sums.a.shape[1]
    for x in range(0, width, LANES):
        a, b, c = zeros(), zeros(), zeros()
        for k in range(SIZE):
            a = fma(WINDOW[k], load_some(factors.a, x + k, LANES), a)
            b = fma(WINDOW[k], load_some(factors.b, x + k, LANES), b)
            c = fma(WINDOW[k], load_some(factors.c, x + k, LANES), c)
        store_some(sums.a, row * width + x, LANES, a)
        store_some(sums.b, row * width + x, LANES, b)
        store_some(sums.c, row * width + x, LANES, c)


@inline
def _finish_row(gradient, sums, row, images, first, weights):
    """Return the sum of |d| over the row of pixels that begins at `first`; write their gradient.

    The sums of their windows are the rows of `sums` from `row` on.
    """
    W, width = images.rendered.shape[2], sums.a.shape[1]
    error = zeros()
    for x in range(0, W, LANES):
        count = min(LANES, W - x)
        rendered = load_some(images.rendered, first + x, count)
        target = load_some(images.target, first + x, count)
        d = rendered - target
        error = error + max(d, ZERO - d)
        if gradient is not None:
            # The sign of 0 is 0, that of NaN is NaN.
            sign = where(less(zeros(), d), zeros() + ONE, where(less(d, zeros()), zeros() - ONE, d))
            a, b, c = zeros(), zeros(), zeros()
            if weights.window > ZERO:
                for k in range(SIZE):
                    place = (row + k) * width + x
                    a = fma(WINDOW[k], load_some(sums.a, place, LANES), a)
                    b = fma(WINDOW[k], load_some(sums.b, place, LANES), b)
                    c = fma(WINDOW[k], load_some(sums.c, place, LANES), c)
            similar = fma(b, d, fma(c, rendered + target, a))
            grad = fma(weights.window, similar, weights.pixel * sign)
            store_some(gradient, first + x, count, grad)
    return total(error)
