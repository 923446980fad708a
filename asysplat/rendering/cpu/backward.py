"""Gradients of the splats from those of the pixels, front to back and without stored states.

What lies behind a splat is what is left of the finished pixel once the splats up to it are taken
away, so the transmittance is never divided back up. Each pair of splat and tile has a place of its
own for its gradient: no two threads write to one, and sums have a fixed order.
"""

import numpy as np

from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.kernel import inline, kernel
from asysplat.rendering.cpu.lanes import (
    HALF,
    LANES,
    MIDDLE,
    ONE,
    ZERO,
    alpha_at,
    fma,
    prefetch,
    take_sum,
)
from asysplat.rendering.cpu.tile import (
    AHEAD,
    CHECK,
    PIXELS,
    PLANE,
    aligned,
    center_offset,
    corner,
    is_opaque,
    rows_in_reach,
    whitened_start,
)

# Planes of a tile's state: what passes through; what lies behind, the background included, times
# its gradient; gradients.
BEHIND, G_RED, G_GREEN, G_BLUE, G_DEPTH, G_MEDIAN = (plane * PLANE for plane in range(1, 7))
PLANES = 7
# Sums over the rows of a splat, for each column: of the exponent's gradient e, e u, e u y, e y,
# e y^2, and of the values' gradients.
E, EU, EUY, EY, EYY, RED, GREEN, BLUE, DEPTH, EUX = (PLANES * PLANE + k * LANES for k in range(10))
SUMS = 10


@inline
def draw_row_backward(
    state, base, dy, a, middle, exponent, color, z, convention, depth, grad_median
):
    """Add the row that begins at `base`, `dy` below the splat's centre, to the sums; see
    `draw_row`."""
    alpha_min, alpha_max, transmittance_min = convention
    red, green, blue = color
    for i in range(LANES):
        u = fma(a, np.float32(i) - MIDDLE, middle)
        opacity = alpha_at(u, exponent, alpha_min, alpha_max)
        before = state[base + i]
        after = fma(-opacity, before, before)
        keep = ONE if after >= transmittance_min else ZERO
        weight = opacity * before * keep
        state[base + i] = after * keep
        value = red * state[G_RED + base + i]
        value = fma(green, state[G_GREEN + base + i], value)
        value = fma(blue, state[G_BLUE + base + i], value)
        if depth is not None:
            value = fma(z, state[G_DEPTH + base + i], value)
        behind = fma(-weight, value, state[BEHIND + base + i])
        state[BEHIND + base + i] = behind
        # Clamped alphas do not answer.
        moves = keep if opacity < alpha_max else ZERO
        e = moves * fma(weight, value, -opacity * behind / (ONE - opacity))
        eu, ey = e * u, e * dy
        state[E + i] += e
        state[EU + i] += eu
        state[EUY + i] = fma(eu, dy, state[EUY + i])
        state[EY + i] += ey
        state[EYY + i] = fma(ey, dy, state[EYY + i])
        state[RED + i] = fma(weight, state[G_RED + base + i], state[RED + i])
        state[GREEN + i] = fma(weight, state[G_GREEN + base + i], state[GREEN + i])
        state[BLUE + i] = fma(weight, state[G_BLUE + base + i], state[BLUE + i])
        if depth is not None:
            state[DEPTH + i] = fma(weight, state[G_DEPTH + base + i], state[DEPTH + i])
        if grad_median is not None:
            halved = before > HALF and weight > ZERO and after <= HALF
            state[DEPTH + i] += state[G_MEDIAN + base + i] if halved else ZERO


@kernel
def rasterize_backward(
    start,
    stop,
    splats,
    first_entry,
    last_entry,
    entries,
    grid,
    convention,
    skips,
    image,
    transmittance,
    depth,
    grad_image,
    grad_transmittance,
    grad_depth,
    grad_median,
    grads,
):
    """Write `grads` [pairs, 10], see `layout`, of every pair in tiles start to stop.

    The other arguments are those of `rasterize`, its results, and their gradients.
    """
    skip_rows, skip_opaque = skips
    bases = splats.view(np.int32)
    state = aligned(PLANES * PLANE + SUMS * LANES)
    for tile in range(start, stop):
        picture, left, top, rows, columns = corner(tile, grid)
        state[:PIXELS] = ONE
        state[PIXELS:] = ZERO
        for row in range(rows):
            for i in range(columns):
                pixel, at_y, at_x = row * LANES + i, top + row, left + i
                g_red = grad_image[picture, 0, at_y, at_x]
                g_green = grad_image[picture, 1, at_y, at_x]
                g_blue = grad_image[picture, 2, at_y, at_x]
                behind = (
                    transmittance[picture, at_y, at_x] * grad_transmittance[picture, at_y, at_x]
                )
                behind += image[picture, 0, at_y, at_x] * g_red
                behind += image[picture, 1, at_y, at_x] * g_green
                behind += image[picture, 2, at_y, at_x] * g_blue
                state[G_RED + pixel] = g_red
                state[G_GREEN + pixel] = g_green
                state[G_BLUE + pixel] = g_blue
                if grad_median is not None:
                    state[G_MEDIAN + pixel] = grad_median[picture, at_y, at_x]
                if depth is not None:
                    state[G_DEPTH + pixel] = grad_depth[picture, at_y, at_x]
                    behind += depth[picture, at_y, at_x] * grad_depth[picture, at_y, at_x]
                state[BEHIND + pixel] = behind
        live = (1 << rows) - 1
        end = last_entry[tile]
        for position in range(first_entry[tile], end):
            d, pair = entries[position, 0], entries[position, 1]
            prefetch(splats, entries[min(position + AHEAD, end - 1), 0])
            look = skip_opaque and position & CHECK == CHECK
            x, y = center_offset(splats, bases, d, left, top)
            u0, b = whitened_start(splats, d, x, y)
            first, last = rows_in_reach(splats, d, y, rows) if skip_rows else (0, rows - 1)
            a, c, log_opacity = splats[d, col.A], splats[d, col.C], splats[d, col.LOG_OPACITY]
            color = (splats[d, col.RED], splats[d, col.GREEN], splats[d, col.BLUE])
            z = splats[d, col.DEPTH]
            for row in range(first, last + 1):
                if not (live >> row) & 1:
                    continue
                base = (row & (col.TILE - 1)) * LANES
                dy = np.float32(y + row)
                v = c * dy
                exponent = fma(-v, v, log_opacity)
                middle = np.float32(u0 + b * row)
                draw_row_backward(
                    state, base, dy, a, middle, exponent, color, z, convention, depth, grad_median
                )
                if look and is_opaque(state, base):
                    live &= ~(1 << row)
            for i in range(LANES):
                state[EUX + i] = state[EU + i] * (np.float32(x) + (np.float32(i) - MIDDLE))
            eu, ey = take_sum(state, EU), take_sum(state, EY)
            # The exponent is LOG_OPACITY - u^2 - v^2, u = A x + B y, v = C y, of minus the centre.
            grads[pair, col.G_X] = 2 * a * eu
            grads[pair, col.G_Y] = np.float32(2 * b) * eu + 2 * c * c * ey
            grads[pair, col.G_A] = -2 * take_sum(state, EUX)
            grads[pair, col.G_B] = -2 * take_sum(state, EUY)
            grads[pair, col.G_C] = -2 * c * take_sum(state, EYY)
            grads[pair, col.G_LOG_OPACITY] = take_sum(state, E)
            grads[pair, col.G_RED] = take_sum(state, RED)
            grads[pair, col.G_GREEN] = take_sum(state, GREEN)
            grads[pair, col.G_BLUE] = take_sum(state, BLUE)
            grads[pair, col.G_DEPTH] = take_sum(state, DEPTH)
        for position in range(last_entry[tile], first_entry[tile + 1]):
            grads[entries[position, 1]] = ZERO
