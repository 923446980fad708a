"""Gradients of the splats from those of the pixels, back to front.

What lies behind a splat is summed up on the way, from little to much, so that nothing cancels; the
transmittance before it is that behind it over 1 - alpha, which keeps its relative precision. Which
splats a pixel saw is what the forward pass left: where it stopped. Each pair of splat and tile has
a place of its own for its gradient.
"""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering.cuda.splat import GRADIENT, load_color, load_depth, load_shape
from asysplat.rendering.cuda.tile import HALF_TILE, TILE, alpha_at, color_pixels, tile_pixels


@kernel
def draw_tile_backward(
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
    """Write `grads` [pairs, 10], see `splat`, of every pair in the tile.

    The other arguments are those of `draw_tile`, its results, and their gradients; and the place
    [pairs] of each pair's gradient.
    """
    tile = tl.program_id(0).to(tl.int64)
    picture, left, top, lane_x, lane_y, pixel, inside = tile_pixels(
        tile, columns, tiles, height, width
    )
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, picture, height, width)
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
            x, rest_x, y, rest_y, u, a, b, c, log_opacity = load_shape(
                splats, d, left, top, HALF_TILE, there
            )
            red, green, blue = load_color(splats, d, there)
            dx = (x + lane_x) + rest_x
            dy = (y + lane_y) + rest_y
            v = c * dy
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            shows = alpha_at(u, v, log_opacity, alpha_min, alpha_max)
            shows = tl.where(rank < stop, shows, 0.0)
            rest = 1 - shows
            inverse = 1 / rest
            before = passed * inverse
            before = tl.fma(tl.fma(-before, rest, passed), inverse, before)  # to the last bit
            weight = shows * before
            passed = before
            value = tl.fma(blue, g_blue, tl.fma(green, g_green, red * g_red))
            if DEPTH:
                z, rest_z = load_depth(splats, d, there)
                value = tl.fma((z - origin) + rest_z, g_depth, value)
                tl.store(grad + 9, tl.sum(weight * g_depth, 0), mask=there)
            if MEDIAN:
                tl.store(grad + 9, tl.sum(tl.where(rank == half, g_depth, 0.0), 0), mask=there)
            # alpha dL/dalpha; clamped alphas do not answer.
            e = tl.fma(weight, value, -shows * inverse * behind)
            e = tl.where(shows < alpha_max, e, 0.0)
            behind = tl.fma(weight, value, behind)
            # The exponent is log_opacity - u^2 - v^2, u = a x + b y, v = c y, of minus the centre.
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
    # Nothing shows of those behind.
    lane = tl.arange(0, TILE * TILE)
    last = tl.load(first_entry + tile + 1)
    while end < last:
        there = end + lane < last
        grad = grads + GRADIENT * tl.load(pairs + end + lane, mask=there, other=0)
        for k in tl.static_range(GRADIENT):
            tl.store(grad + k, tl.zeros(lane.shape, tl.float32), mask=there)
        end += TILE * TILE
