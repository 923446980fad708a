"""Rasterize splats and compute their gradients, as `cpu.rasterize`: a program takes a tile."""

from typing import NamedTuple

import triton.language as tl
from torch import Tensor

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering.cuda.splat import (
    COLUMNS,
    GRADIENT,
    TILE,
    color_pixels,
    load_color,
    load_depth,
    load_splat,
    tile_window,
)

NO_STOP = tl.constexpr(2**31 - 1)  # more than any rank


class SavedForBackward(NamedTuple):
    """See `cpu.rasterize.SavedForBackward`; median_ranks are -1 without a median depth."""

    transmittance: Tensor
    stop_ranks: Tensor
    last_entry: Tensor
    origins: Tensor | None
    median_ranks: Tensor | None


@kernel
def alpha_at(u, v, log_opacity, alpha_min, alpha_max):
    """Compute alpha of a splat, 0 below alpha_min."""
    alpha = tl.exp2(tl.fma(-u, u, tl.fma(-v, v, log_opacity)))
    alpha = tl.minimum(alpha, alpha_max)
    return tl.where(alpha >= alpha_min, alpha, 0.0)


@kernel
def store_row(grad, values, valid, CHANNELS: tl.constexpr):
    """Write the first CHANNELS of the ten `values` next to each other, at once."""
    column = tl.arange(0, COLUMNS)
    row = tl.zeros((COLUMNS,), tl.float32)
    for k in tl.static_range(CHANNELS):
        row = tl.where(column == k, values[k], row)
    tl.store(grad + column, row, mask=valid & (column < CHANNELS))


@kernel
def rasterize(
    splats,
    entries,
    first_entry,
    last_entry,
    active,  # read with MASKED
    image,
    alpha,
    transmittance,
    depth,  # written with DEPTH or MEDIAN
    origins,  # written with DEPTH
    stop_ranks,
    median_ranks,  # written with MEDIAN
    columns,
    tiles,
    height,
    width,
    alpha_min,
    alpha_max,
    transmittance_min,
    MASKED: tl.constexpr,
    DEPTH: tl.constexpr,
    MEDIAN: tl.constexpr,
    CULL_OPAQUE: tl.constexpr,
    STEP: tl.constexpr,  # splats between two checks whether all pixels are opaque
):
    """Draw a tile; every pixel is written. See `cpu.rasterize`."""
    tile = tl.program_id(0).to(tl.int64)
    image_index, left, top, lane_x, lane_y, pixel, inside = tile_window(
        tile, columns, tiles, height, width
    )
    remaining = tl.full(lane_x.shape, 1.0, tl.float32)
    live = inside
    stop = tl.full(lane_x.shape, NO_STOP, tl.int32)
    total_alpha = tl.zeros_like(remaining)
    total_red = tl.zeros_like(remaining)
    total_green = tl.zeros_like(remaining)
    total_blue = tl.zeros_like(remaining)
    total_depth = tl.zeros_like(remaining)
    origin = tl.zeros_like(remaining)
    median_rank = tl.full(lane_x.shape, -1, tl.int32)
    first = tl.load(first_entry + tile)
    end = tl.load(first_entry + tile + 1)
    if MASKED:
        end = tl.where(tl.load(active + tile), end, first)
    position = first
    drawing = position < end
    while drawing:
        for k in tl.static_range(STEP):
            valid = position + k < end
            rank = (position + k - first).to(tl.int32)
            d = tl.load(entries + position + k, mask=valid, other=0).to(tl.int64)
            _, _, y, rest_y, u, a, b, c, log_opacity = load_splat(splats, d, left, top, valid)
            red, green, blue = load_color(splats, d, valid)
            v = c * ((y + lane_y) + rest_y)
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            opacity = tl.where(live, alpha_at(u, v, log_opacity, alpha_min, alpha_max), 0.0)
            transmitted = tl.fma(-opacity, remaining, remaining)
            drops = live & (transmitted < transmittance_min)
            stop = tl.where(drops, rank, stop)
            live = live & (transmitted >= transmittance_min)
            opacity = tl.where(drops, 0.0, opacity)
            weight = opacity * remaining
            total_alpha += weight
            total_red = tl.fma(weight, red, total_red)
            total_green = tl.fma(weight, green, total_green)
            total_blue = tl.fma(weight, blue, total_blue)
            if DEPTH:
                # Relative to the first visible depth: the blended differences are small.
                z, rest_z = load_depth(splats, d, valid)
                origin = tl.where((remaining == 1) & (weight > 0), z, origin)
                total_depth = tl.fma(weight, (z - origin) + rest_z, total_depth)
            if MEDIAN:
                z, _ = load_depth(splats, d, valid)
                crosses_half = (remaining > 0.5) & (weight > 0) & (transmitted <= 0.5)
                total_depth = tl.where(crosses_half, z, total_depth)
                median_rank = tl.where(crosses_half, rank, median_rank)
            remaining = tl.where(drops, remaining, transmitted)
        position += STEP
        drawing = position < end
        if CULL_OPAQUE:
            drawing = drawing & (tl.max(live.to(tl.int32), 0) > 0)
    tl.store(last_entry + tile, tl.minimum(position, end))
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, image_index, height, width)
    tl.store(alpha + pixel, total_alpha, mask=inside)
    tl.store(transmittance + pixel, remaining, mask=inside)
    tl.store(stop_ranks + pixel, stop, mask=inside)
    tl.store(image + red_pixel, total_red, mask=inside)
    tl.store(image + green_pixel, total_green, mask=inside)
    tl.store(image + blue_pixel, total_blue, mask=inside)
    if DEPTH:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(origins + pixel, origin, mask=inside)
    if MEDIAN:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(median_ranks + pixel, median_rank, mask=inside)


@kernel
def rasterize_backward(
    splats,
    entries,
    first_entry,
    last_entry,
    transmittance,
    origins,
    stop_ranks,
    median_ranks,
    grad_image,
    grad_transmittance,
    grad_depth,
    grads,
    first_tile,
    columns,
    tiles,
    height,
    width,
    alpha_min,
    alpha_max,
    DEPTH: tl.constexpr,
    MEDIAN: tl.constexpr,
    STEP: tl.constexpr,
):
    """Compute the gradients of every pair in the tile; see `cpu.rasterize`.

    They follow those of the tiles from `first_tile` on: [pairs, 10], and [pairs, 9] without depth.
    """
    CHANNELS: tl.constexpr = GRADIENT if DEPTH or MEDIAN else GRADIENT - 1
    tile = tl.program_id(0).to(tl.int64) + first_tile
    image_index, left, top, lane_x, lane_y, pixel, inside = tile_window(
        tile, columns, tiles, height, width
    )
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, image_index, height, width)
    g_red = tl.load(grad_image + red_pixel, mask=inside, other=0.0)
    g_green = tl.load(grad_image + green_pixel, mask=inside, other=0.0)
    g_blue = tl.load(grad_image + blue_pixel, mask=inside, other=0.0)
    remaining = tl.load(transmittance + pixel, mask=inside, other=1.0)
    # The light from behind, the background included, times its gradient.
    light_behind = remaining * tl.load(grad_transmittance + pixel, mask=inside, other=0.0)
    stop = tl.load(stop_ranks + pixel, mask=inside, other=0)
    if DEPTH or MEDIAN:
        g_depth = tl.load(grad_depth + pixel, mask=inside, other=0.0)
    if DEPTH:
        origin = tl.load(origins + pixel, mask=inside, other=0.0)
    if MEDIAN:
        median_rank = tl.load(median_ranks + pixel, mask=inside, other=-1)
    first = tl.load(first_entry + tile)
    end = tl.load(last_entry + tile)
    grads -= CHANNELS * tl.load(first_entry + first_tile)
    position = end - 1
    while position >= first:
        # Loads first: they would wait for the stores of the splat before, which they may follow.
        rows = ()
        for k in tl.static_range(STEP):
            valid = position - k >= first
            d = tl.load(entries + position - k, mask=valid, other=0).to(tl.int64)
            splat = load_splat(splats, d, left, top, valid) + load_color(splats, d, valid)
            if DEPTH:
                splat = splat + load_depth(splats, d, valid)
            rows = rows + ((valid, splat),)
        for k in tl.static_range(STEP):
            valid, splat = rows[k]
            rank = (position - k - first).to(tl.int32)
            x, rest_x, y, rest_y, u = splat[0], splat[1], splat[2], splat[3], splat[4]
            a, b, c, log_opacity = splat[5], splat[6], splat[7], splat[8]
            red, green, blue = splat[9], splat[10], splat[11]
            dx = (x + lane_x) + rest_x
            dy = (y + lane_y) + rest_y
            v = c * dy
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            opacity = alpha_at(u, v, log_opacity, alpha_min, alpha_max)
            opacity = tl.where(rank < stop, opacity, 0.0)
            rest = 1 - opacity
            inverse = 1 / rest
            before = remaining * inverse
            before = tl.fma(tl.fma(-before, rest, remaining), inverse, before)  # to the last bit
            weight = opacity * before
            remaining = before
            value = tl.fma(blue, g_blue, tl.fma(green, g_green, red * g_red))
            g_z = 0.0
            if DEPTH:
                value = tl.fma((splat[12] - origin) + splat[13], g_depth, value)
                g_z += tl.sum(weight * g_depth, 0)
            if MEDIAN:
                g_z += tl.sum(tl.where(rank == median_rank, g_depth, 0.0), 0)
            # alpha dL/dalpha; a clamped alpha is constant.
            e = tl.fma(weight, value, -opacity * inverse * light_behind)
            e = tl.where(opacity < alpha_max, e, 0.0)
            light_behind = tl.fma(weight, value, light_behind)
            # The exponent is log_opacity - u^2 - v^2; u = a x + b y, v = c y, x and y of the pixel
            # relative to the center.
            eu, ey = e * u, e * dy
            sum_eu = tl.sum(eu, 0)
            g_y = 2 * b * sum_eu + 2 * c * c * tl.sum(ey, 0)
            g_a, g_b = -2 * tl.sum(eu * dx, 0), -2 * tl.sum(eu * dy, 0)
            g_c = -2 * c * tl.sum(ey * dy, 0)
            colors = (tl.sum(weight * g_red, 0), tl.sum(weight * g_green, 0))
            colors = colors + (tl.sum(weight * g_blue, 0),)
            values = (2 * a * sum_eu, g_y, g_a, g_b, g_c, tl.sum(e, 0)) + colors + (g_z,)
            store_row(grads + CHANNELS * (position - k), values, valid, CHANNELS)
        position -= STEP
    # Splats behind the stop have no gradient.
    lane = tl.arange(0, TILE * TILE)
    last = tl.load(first_entry + tile + 1)
    while end < last:
        valid = end + lane < last
        for k in tl.static_range(CHANNELS):
            tl.store(
                grads + CHANNELS * (end + lane) + k, tl.zeros(lane.shape, tl.float32), mask=valid
            )
        end += TILE * TILE
