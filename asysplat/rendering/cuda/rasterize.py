"""Splats to pixels, and their gradients back: a program takes a tile.

The forward pass blends front to back. The backward pass goes back to front: what lies behind a
splat is summed up on the way, from little to much, so that nothing cancels; the transmittance
before it is that behind it over 1 - alpha, which keeps its relative precision. Which splats a pixel
saw is what the forward pass saved: where it stopped. Each pair of splat and tile has a place of its
own for its gradient.
"""

from typing import NamedTuple

import triton.language as tl
from torch import Tensor

from asysplat.ops.triton_utils import kernel
from asysplat.rendering.cuda.splat import (
    GRADIENT,
    TILE,
    color_pixels,
    load_color,
    load_depth,
    load_splat,
    tile_window,
)

NEVER = tl.constexpr(2**31 - 1)  # more than any rank


class Saved(NamedTuple):
    """What `rasterize` leaves for `rasterize_backward`; see there."""

    transmittance: Tensor
    stops: Tensor
    last_entry: Tensor
    origins: Tensor | None
    halved: Tensor | None


@kernel
def alpha_at(u, v, log_opacity, alpha_min, alpha_max):
    """Compute alpha of a splat, 0 below alpha_min."""
    alpha = tl.exp2(tl.fma(-u, u, tl.fma(-v, v, log_opacity)))
    alpha = tl.minimum(alpha, alpha_max)
    return tl.where(alpha >= alpha_min, alpha, 0.0)


@kernel
def rasterize(
    splats,
    entries,
    first_entry,
    last_entry,
    wanted,
    image,
    alpha,
    transmittance,
    depth,
    origins,
    stops,
    halved,
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
    STEP: tl.constexpr,
):
    """Draw a tile: every pixel of it is written.

    Args:
        splats: [images * N, 16], see `splat`.
        entries: [pairs] the splat of each, sorted by tile, then by depth.
        first_entry: [tiles + 1] where each tile's list begins.
        last_entry: [tiles] is set to where it was left, all its pixels being opaque.
        wanted: [tiles] whether to draw it; read only with MASKED.
        image, alpha, transmittance, depth, origins: see `RenderOutputs`; DEPTH and MEDIAN say
            whether depth is asked for, and which; only DEPTH has origins.
        stops: [images, H, W] the rank in its list of the splat that a pixel dropped, and all behind
            it; NEVER where it dropped none.
        halved: [images, H, W] the rank of the splat of the median depth, -1 without one.
        columns, tiles: of an image.
        STEP: splats between two looks at whether all pixels are opaque.
    """
    tile = tl.program_id(0).to(tl.int64)
    image_index, left, top, lane_x, lane_y, pixel, inside = tile_window(
        tile, columns, tiles, height, width
    )
    passed = tl.full(lane_x.shape, 1.0, tl.float32)
    live = inside
    stop = tl.full(lane_x.shape, NEVER, tl.int32)
    total_alpha = tl.zeros_like(passed)
    total_red = tl.zeros_like(passed)
    total_green = tl.zeros_like(passed)
    total_blue = tl.zeros_like(passed)
    total_depth = tl.zeros_like(passed)
    origin = tl.zeros_like(passed)
    half = tl.full(lane_x.shape, -1, tl.int32)
    first = tl.load(first_entry + tile)
    end = tl.load(first_entry + tile + 1)
    if MASKED:
        end = tl.where(tl.load(wanted + tile), end, first)
    position = first
    drawing = position < end
    while drawing:
        for k in tl.static_range(STEP):
            there = position + k < end
            rank = (position + k - first).to(tl.int32)
            d = tl.load(entries + position + k, mask=there, other=0).to(tl.int64)
            _, _, y, rest_y, u, a, b, c, log_opacity = load_splat(splats, d, left, top, there)
            red, green, blue = load_color(splats, d, there)
            v = c * ((y + lane_y) + rest_y)
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            opacity = tl.where(live, alpha_at(u, v, log_opacity, alpha_min, alpha_max), 0.0)
            behind = tl.fma(-opacity, passed, passed)
            drops = live & (behind < transmittance_min)
            stop = tl.where(drops, rank, stop)
            live = live & (behind >= transmittance_min)
            opacity = tl.where(drops, 0.0, opacity)
            weight = opacity * passed
            total_alpha += weight
            total_red = tl.fma(weight, red, total_red)
            total_green = tl.fma(weight, green, total_green)
            total_blue = tl.fma(weight, blue, total_blue)
            if DEPTH:
                # From the depth of the first that shows: what is blended are small differences.
                z, rest_z = load_depth(splats, d, there)
                origin = tl.where((passed == 1) & (weight > 0), z, origin)
                total_depth = tl.fma(weight, (z - origin) + rest_z, total_depth)
            if MEDIAN:
                z, _ = load_depth(splats, d, there)
                halves = (passed > 0.5) & (weight > 0) & (behind <= 0.5)
                total_depth = tl.where(halves, z, total_depth)
                half = tl.where(halves, rank, half)
            passed = tl.where(drops, passed, behind)
        position += STEP
        drawing = position < end
        if CULL_OPAQUE:
            drawing = drawing & (tl.max(live.to(tl.int32), 0) > 0)
    tl.store(last_entry + tile, tl.minimum(position, end))
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, image_index, height, width)
    tl.store(alpha + pixel, total_alpha, mask=inside)
    tl.store(transmittance + pixel, passed, mask=inside)
    tl.store(stops + pixel, stop, mask=inside)
    tl.store(image + red_pixel, total_red, mask=inside)
    tl.store(image + green_pixel, total_green, mask=inside)
    tl.store(image + blue_pixel, total_blue, mask=inside)
    if DEPTH:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(origins + pixel, origin, mask=inside)
    if MEDIAN:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(halved + pixel, half, mask=inside)


@kernel
def rasterize_backward(
    splats,
    entries,
    pairs,
    first_entry,
    last_entry,
    transmittance,
    origins,
    stops,
    halved,
    grad_image,
    grad_transmittance,
    grad_depth,
    grads,
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
    """Compute the gradients of every pair in the tile.

    Args:
        pairs: [pairs] the place of each entry's gradient.
        grad_image, grad_transmittance, grad_depth: gradients of what `rasterize` drew.
        grads: [pairs, 10], see `splat`; written.
        Others: as for `rasterize`, which wrote last_entry, transmittance, origins, stops, halved.
    """
    tile = tl.program_id(0).to(tl.int64)
    image_index, left, top, lane_x, lane_y, pixel, inside = tile_window(
        tile, columns, tiles, height, width
    )
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, image_index, height, width)
    g_red = tl.load(grad_image + red_pixel, mask=inside, other=0.0)
    g_green = tl.load(grad_image + green_pixel, mask=inside, other=0.0)
    g_blue = tl.load(grad_image + blue_pixel, mask=inside, other=0.0)
    passed = tl.load(transmittance + pixel, mask=inside, other=1.0)
    # What lies behind, the background included, times its gradient.
    behind = passed * tl.load(grad_transmittance + pixel, mask=inside, other=0.0)
    stop = tl.load(stops + pixel, mask=inside, other=0)
    if DEPTH or MEDIAN:
        g_depth = tl.load(grad_depth + pixel, mask=inside, other=0.0)
    if DEPTH:
        origin = tl.load(origins + pixel, mask=inside, other=0.0)
    if MEDIAN:
        half = tl.load(halved + pixel, mask=inside, other=-1)
    first = tl.load(first_entry + tile)
    end = tl.load(last_entry + tile)
    position = end - 1
    while position >= first:
        for k in tl.static_range(STEP):
            there = position - k >= first
            rank = (position - k - first).to(tl.int32)
            d = tl.load(entries + position - k, mask=there, other=0).to(tl.int64)
            grad = grads + GRADIENT * tl.load(pairs + position - k, mask=there, other=0)
            x, rest_x, y, rest_y, u, a, b, c, log_opacity = load_splat(splats, d, left, top, there)
            red, green, blue = load_color(splats, d, there)
            dx = (x + lane_x) + rest_x
            dy = (y + lane_y) + rest_y
            v = c * dy
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            opacity = alpha_at(u, v, log_opacity, alpha_min, alpha_max)
            opacity = tl.where(rank < stop, opacity, 0.0)
            rest = 1 - opacity
            inverse = 1 / rest
            before = passed * inverse
            before = tl.fma(tl.fma(-before, rest, passed), inverse, before)  # to the last bit
            weight = opacity * before
            passed = before
            value = tl.fma(blue, g_blue, tl.fma(green, g_green, red * g_red))
            if DEPTH:
                z, rest_z = load_depth(splats, d, there)
                value = tl.fma((z - origin) + rest_z, g_depth, value)
                tl.store(grad + 9, tl.sum(weight * g_depth, 0), mask=there)
            if MEDIAN:
                tl.store(grad + 9, tl.sum(tl.where(rank == half, g_depth, 0.0), 0), mask=there)
            # alpha dL/dalpha; a clamped alpha is constant.
            e = tl.fma(weight, value, -opacity * inverse * behind)
            e = tl.where(opacity < alpha_max, e, 0.0)
            behind = tl.fma(weight, value, behind)
            # The exponent is log_opacity - u^2 - v^2, u = a x + b y, v = c y, of minus the center.
            eu, ey = e * u, e * dy
            sum_eu = tl.sum(eu, 0)
            tl.store(grad, 2 * a * sum_eu, mask=there)
            tl.store(grad + 1, 2 * b * sum_eu + 2 * c * c * tl.sum(ey, 0), mask=there)
            tl.store(grad + 2, -2 * tl.sum(eu * dx, 0), mask=there)
            tl.store(grad + 3, -2 * tl.sum(eu * dy, 0), mask=there)
            tl.store(grad + 4, -2 * c * tl.sum(ey * dy, 0), mask=there)
            tl.store(grad + 5, tl.sum(e, 0), mask=there)
            tl.store(grad + 6, tl.sum(weight * g_red, 0), mask=there)
            tl.store(grad + 7, tl.sum(weight * g_green, 0), mask=there)
            tl.store(grad + 8, tl.sum(weight * g_blue, 0), mask=there)
        position -= STEP
    # Splats behind the stop have no gradient.
    lane = tl.arange(0, TILE * TILE)
    last = tl.load(first_entry + tile + 1)
    while end < last:
        there = end + lane < last
        grad = grads + GRADIENT * tl.load(pairs + end + lane, mask=there, other=0)
        for k in tl.static_range(GRADIENT):
            tl.store(grad + k, tl.zeros(lane.shape, tl.float32), mask=there)
        end += TILE * TILE
