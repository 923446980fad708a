"""Gradients of the splats from those of the pixels, front to back and without stored states.

What lies behind a splat is what is left of the finished pixel once the splats up to it are taken
away, so the transmittance is never divided back up. Each pair of splat and tile has a place of its
own for its gradient.
"""

import math

import triton.language as tl

from asysplat.rendering.cuda.kernel import (
    alpha_at,
    kernel,
    load_color,
    load_shape,
    offset,
    tile_pixels,
)

TWO_LN2 = tl.constexpr(2 * math.log(2))


@kernel
def draw_tile_backward(
    splats,
    entries,
    pairs,
    first_entry,
    last_entry,
    image,
    alpha,
    depth,
    grad_image,
    grad_alpha,
    grad_depth,
    grads,
    columns,
    tiles,
    height,
    width,
    alpha_min,
    alpha_max,
    transmittance_min,
    HAS_DEPTH: tl.constexpr,
    MEDIAN: tl.constexpr,
    CHANNELS: tl.constexpr,
    TILE: tl.constexpr,
    STEP: tl.constexpr,
):
    """Write `grads` [P, CHANNELS] of every pair that `draw_tile` drew.

    The other arguments are those of `draw_tile`, its results, and their gradients.
    """
    tile = tl.program_id(0).to(tl.int64)
    picture, column, row, inside = tile_pixels(tile, columns, tiles, height, width, TILE)
    center_x, center_y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    pixel = offset(picture, row, column, height, width)
    red_pixel = offset(3 * picture, row, column, height, width)
    green_pixel = offset(3 * picture + 1, row, column, height, width)
    blue_pixel = offset(3 * picture + 2, row, column, height, width)
    g_alpha = tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    g_red = tl.load(grad_image + red_pixel, mask=inside, other=0.0)
    g_green = tl.load(grad_image + green_pixel, mask=inside, other=0.0)
    g_blue = tl.load(grad_image + blue_pixel, mask=inside, other=0.0)
    behind = g_alpha * tl.load(alpha + pixel, mask=inside, other=0.0)
    behind += g_red * tl.load(image + red_pixel, mask=inside, other=0.0)
    behind += g_green * tl.load(image + green_pixel, mask=inside, other=0.0)
    behind += g_blue * tl.load(image + blue_pixel, mask=inside, other=0.0)
    if HAS_DEPTH:
        g_depth = tl.load(grad_depth + pixel, mask=inside, other=0.0)
        if not MEDIAN:
            behind += g_depth * tl.load(depth + pixel, mask=inside, other=0.0)
    left_over = inside.to(tl.float32)
    position = tl.load(first_entry + tile)
    end = tl.load(last_entry + tile)
    while position < end:
        for k in tl.static_range(STEP):
            there = position + k < end
            index = tl.load(entries + position + k, mask=there, other=0)
            splat = splats + index.to(tl.int64) * CHANNELS
            grad = grads + tl.load(pairs + position + k, mask=there, other=0) * CHANNELS
            x, y, a, b, c, opacity = load_shape(splat, there)
            red, green, blue = load_color(splat, there)
            before = left_over
            dx, dy = center_x - x, center_y - y
            hit, left_over, u, v = alpha_at(
                dx,
                dy,
                a,
                b,
                c,
                opacity,
                before,
                alpha_min,
                alpha_max,
                transmittance_min,
            )
            weight = hit * before
            shown = g_alpha + g_red * red + g_green * green + g_blue * blue
            if HAS_DEPTH:
                if MEDIAN:
                    halves = (before > 0.5) & (left_over <= 0.5) & (hit > 0)
                    g_z = tl.where(halves, g_depth, 0.0)
                else:
                    z = tl.load(splat + 9, mask=there, other=0.0)
                    shown += g_depth * z
                    g_z = g_depth * weight
                tl.store(grad + 9, tl.sum(g_z, 0), mask=there)
            behind -= weight * shown
            # alpha dL/dalpha, 0 where alpha is clamped.
            e = hit * (before * shown - behind / (1 - hit))
            e = tl.where(hit < alpha_max, e, 0.0)
            g_u = -TWO_LN2 * e * u
            g_v = -TWO_LN2 * e * v
            sum_u = tl.sum(g_u, 0)
            tl.store(grad, -a * sum_u, mask=there)
            tl.store(grad + 1, -b * sum_u - c * tl.sum(g_v, 0), mask=there)
            tl.store(grad + 2, tl.sum(g_u * dx, 0), mask=there)
            tl.store(grad + 3, tl.sum(g_u * dy, 0), mask=there)
            tl.store(grad + 4, tl.sum(g_v * dy, 0), mask=there)
            tl.store(grad + 5, tl.sum(e, 0) / tl.maximum(opacity, alpha_min), mask=there)
            tl.store(grad + 6, tl.sum(g_red * weight, 0), mask=there)
            tl.store(grad + 7, tl.sum(g_green * weight, 0), mask=there)
            tl.store(grad + 8, tl.sum(g_blue * weight, 0), mask=there)
        position += STEP
