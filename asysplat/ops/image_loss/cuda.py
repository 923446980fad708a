"""The loss and its gradient for GPUs (Triton): a program takes some columns down a band of rows.

The formulas are those of `asysplat.ops.image_loss.cpu`, with rows and columns exchanged: a window's
variances are the mean of those within its rows plus that of the rows' means. The last rows stay in
registers. One kernel compares the windows and writes their terms in a, b and c, another sums these
around each pixel.
"""

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, kernel
from asysplat.ops.image_loss import reference

SIZE = tl.constexpr(reference.SIZE)
REACH = tl.constexpr(reference.SIZE - 1)  # pixels of a window beyond its first, either way
WINDOW = tl.constexpr(reference.window_weights().tolist())
C1, C2 = tl.constexpr(reference.C1), tl.constexpr(reference.C2)
COLUMNS, BAND = 128, 16  # columns and rows of a program


def compare_images(
    rendered: Float[Tensor, "*batch 3 H W"],
    target: Float[Tensor, "*batch 3 H W"],
    weights: tuple[float, float],
    keep: bool,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3 H W"] | None]:
    """Compute the loss in float32 and, if `keep`, its gradient; see `asysplat.ops.image_loss`.

    For `weights`, see `reference.loss_weights`.
    """
    *batch, channels, H, W = rendered.shape
    per_pixel, per_window = weights
    planes, bands, tiles = rendered.numel() // (H * W), -(-H // BAND), -(-W // COLUMNS)
    programs, kinds = (tiles, bands, planes), 2 if per_window else 1
    parts = rendered.new_empty(*batch, channels * bands * tiles * kinds, dtype=torch.float64)
    gradient = torch.empty_like(rendered) if keep else None
    factors = None
    if keep and per_window:
        factors = rendered.new_empty(planes, 3, H - REACH.value, W - REACH.value)
    sizes = {"height": H, "width": W, "COLUMNS": COLUMNS, "BAND": BAND}
    with torch.cuda.device_of(rendered):
        if per_window:
            compare_windows[programs](
                *(rendered, target, factors, parts), per_window=per_window, **sizes, **FUSED
            )
        compare_pixels[programs](
            *(rendered, target, factors, gradient, parts),
            per_pixel=per_pixel,
            per_window=per_window,
            KINDS=kinds,
            **sizes,
            **FUSED,
        )
    return parts.sum(-1).float(), gradient


@kernel
def compare_windows(
    rendered,
    target,
    factors,  # [planes, 3, rows, columns], of the windows; None without a gradient
    parts,  # [programs, 2], of the loss: from pixels and from windows
    per_window,  # weight of a window's 1 - SSIM
    height,
    width,
    COLUMNS: tl.constexpr,
    BAND: tl.constexpr,
):
    """Write the weighted sum of 1 - SSIM over the windows that begin in a tile, and their terms.

    The terms in a, b and c are `factors`.
    """
    plane = tl.program_id(2).to(tl.int64)
    begin = tl.program_id(1) * BAND
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    windows, across = height - REACH, width - REACH
    exists = column < across
    total = tl.zeros((COLUMNS,), tl.float32)
    earlier = ()
    for _ in tl.static_range(REACH):
        earlier = earlier + ((total, total, total, total),)
    for step in range(tl.minimum(BAND, windows - begin) + REACH):
        first = (plane * height + begin + step) * width + column
        rows = earlier + (compare_row(rendered + first, target + first, exists),)
        S, D, V, U = 0.0, 0.0, 0.0, 0.0
        for k in tl.static_range(SIZE):
            S += WINDOW[k] * rows[k][0]
            D += WINDOW[k] * rows[k][1]
        for k in tl.static_range(SIZE):
            s, d = rows[k][0] - S, rows[k][1] - D
            V += WINDOW[k] * (s * s + rows[k][2])
            U += WINDOW[k] * (d * d + rows[k][3])
        over_P = 1.0 / (0.5 * (S * S + D * D) + C1)
        over_Q = 1.0 / (0.5 * (V + U) + C2)
        D_over_P, U_over_Q = D * over_P, U * over_Q
        means = 1.0 - D * D_over_P
        window = begin + step - REACH  # the row of windows that this row of pixels completes
        done = column < tl.where(window >= begin, across, 0)
        total += tl.where(done, U_over_Q * means + D * D_over_P, 0.0)
        if factors is not None:
            c = means * U_over_Q * over_Q
            b = 2.0 * means * over_Q - c
            a = (1.0 - U_over_Q) * D_over_P * (2.0 - (S + D) * D_over_P) + (c * S - b * D)
            place = factors + (plane * 3 * windows + window) * across + column
            tl.store(place, a, mask=done)
            tl.store(place + windows * across, b, mask=done)
            tl.store(place + 2 * windows * across, -c, mask=done)
        earlier = rows[1:]
    write_part(parts + 1, 2, per_window * tl.sum(total, 0))


@kernel
def compare_pixels(
    rendered,
    target,
    factors,  # see `compare_windows`; None without windows or a gradient
    gradient,  # None if there is to be none
    parts,  # [programs, KINDS]
    per_pixel,  # weight of a pixel's |d|
    per_window,
    height,
    width,
    KINDS: tl.constexpr,
    COLUMNS: tl.constexpr,
    BAND: tl.constexpr,
):
    """Write the weighted sum of |d| over a tile of pixels, and the gradient of the loss."""
    plane = tl.program_id(2).to(tl.int64)
    begin = tl.program_id(1) * BAND
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    total = tl.zeros((COLUMNS,), tl.float32)
    # Rows of windows that begin above the band and reach into it
    above: tl.constexpr = 0 if factors is None else REACH
    earlier = ()
    for _ in tl.static_range(above):
        earlier = earlier + ((total, total, total),)
    for step in range(tl.minimum(BAND, height - begin) + above):
        row = begin + step - above
        done = column < tl.where(row >= begin, width, 0)
        place = (plane * height + row) * width + column
        x = tl.load(rendered + place, mask=done, other=0.0)
        y = tl.load(target + place, mask=done, other=0.0)
        d = x - y
        total += tl.abs(d)
        if gradient is not None:
            # The sign of 0 is 0, that of NaN is NaN.
            grad = per_pixel * tl.where(d > 0, 1.0, tl.where(d < 0, -1.0, d))
            if factors is not None:
                rows = earlier + (sum_along_row(factors, plane, row, column, height, width),)
                a, b, c = 0.0, 0.0, 0.0
                for k in tl.static_range(SIZE):
                    a += WINDOW[k] * rows[k][0]
                    b += WINDOW[k] * rows[k][1]
                    c += WINDOW[k] * rows[k][2]
                grad += per_window * (a + b * d + c * (x + y))
                earlier = rows[1:]
            tl.store(gradient + place, grad, mask=done)
    write_part(parts, KINDS, per_pixel * tl.sum(total, 0))


@kernel
def compare_row(rendered, target, exists):
    """Return means and variances of s and d over the rows of SIZE pixels from each pixel on."""
    mean_s, mean_d, sums, differences = 0.0, 0.0, (), ()
    for k in tl.static_range(SIZE):
        x = tl.load(rendered + k, mask=exists, other=0.0)
        y = tl.load(target + k, mask=exists, other=0.0)
        mean_s += WINDOW[k] * (x + y)
        mean_d += WINDOW[k] * (x - y)
        sums = sums + (x + y,)
        differences = differences + (x - y,)
    variance_s, variance_d = 0.0, 0.0
    for k in tl.static_range(SIZE):
        s, d = sums[k] - mean_s, differences[k] - mean_d
        variance_s += WINDOW[k] * s * s
        variance_d += WINDOW[k] * d * d
    return mean_s, mean_d, variance_s, variance_d


@kernel
def sum_along_row(factors, plane, row, column, height, width):
    """Return the weighted sums of the factors over the windows of a row that contain each pixel."""
    windows, across = height - REACH, width - REACH
    exists = (row >= 0) & (row < windows)
    a, b, c = 0.0, 0.0, 0.0
    for k in tl.static_range(SIZE):
        window = column - k
        inside = exists & (window >= 0) & (window < across)
        place = factors + (plane * 3 * windows + row) * across + window
        a += WINDOW[k] * tl.load(place, mask=inside, other=0.0)
        b += WINDOW[k] * tl.load(place + windows * across, mask=inside, other=0.0)
        c += WINDOW[k] * tl.load(place + 2 * windows * across, mask=inside, other=0.0)
    return a, b, c


@kernel
def write_part(parts, kinds, part):
    """Write a program's part of the loss, in float64, to `parts`, [programs, kinds]."""
    band = tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)
    program = band * tl.num_programs(0) + tl.program_id(0)
    tl.store(parts + program * kinds, part.to(tl.float64))
