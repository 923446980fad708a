"""Gradients of the splats from those of the pixels, back to front.

What lies behind a splat is summed up on the way, from little to much, so that nothing cancels; the
transmittance before it is that behind it over 1 - alpha, which keeps its relative precision. Which
splats a pixel saw is what the forward pass left: where it stopped. Each pair of splat and tile has
a place of its own for its gradient: no two threads write to one, and sums have a fixed order.
"""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import (
    LANES,
    MIDDLE,
    ONE,
    ZERO,
    alpha_at,
    fma,
    prefetch,
    take_sum,
)
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.tile import (
    AHEAD,
    PIXELS,
    PLANE,
    aligned,
    center_offset,
    corner,
    row_of,
    rows_in_reach,
    whitened_start,
)

# Planes of a tile's state: what passes through; what lies behind, the background included, times
# its gradient; the rank that the pixel stopped at; the origin of its depth; the rank of its median
# depth; gradients.
BEHIND, STOP, ORIGIN, HALVED, G_RED, G_GREEN, G_BLUE, G_DEPTH, G_MEDIAN = (
    plane * PLANE for plane in range(1, 10)
)
PLANES = 10
# Sums over the rows of a splat, for each column: of the exponent's gradient e, e u, e u y, e y,
# e y^2, and of the values' gradients.
E, EU, EUY, EY, EYY, RED, GREEN, BLUE, DEPTH, EUX = (PLANES * PLANE + k * LANES for k in range(10))
SUMS = 10


@inline
def draw_row_backward(
    state,
    base,
    rank,
    dy,
    a,
    middle,
    exponent,
    color,
    z,
    z_rest,
    convention,
    grad_depth,
    grad_median,
):
    """Add the row that begins at `base`, `dy` below the splat's centre, to the sums; see
    `draw_row`."""
    alpha_min, alpha_max, _ = convention
    red, green, blue = color
    for i in range(LANES):
        u = fma(a, np.float32(i) - MIDDLE, middle)
        opacity = alpha_at(u, exponent, alpha_min, alpha_max)
        opacity = opacity if rank < state[STOP + base + i] else ZERO
        passed = ONE - opacity
        inverse = ONE / passed
        after = state[base + i]
        before = after * inverse
        before = fma(fma(-before, passed, after), inverse, before)  # to the last bit
        weight = opacity * before
        state[base + i] = before
        value = red * state[G_RED + base + i]
        value = fma(green, state[G_GREEN + base + i], value)
        value = fma(blue, state[G_BLUE + base + i], value)
        if grad_depth is not None:
            dz = (z - state[ORIGIN + base + i]) + z_rest
            value = fma(dz, state[G_DEPTH + base + i], value)
        behind = state[BEHIND + base + i]
        state[BEHIND + base + i] = fma(weight, value, behind)
        # Clamped alphas do not answer.
        moves = ONE if opacity < alpha_max else ZERO
        e = moves * fma(weight, value, -opacity * inverse * behind)
        eu, ey = e * u, e * dy
        state[E + i] += e
        state[EU + i] += eu
        state[EUY + i] = fma(eu, dy, state[EUY + i])
        state[EY + i] += ey
        state[EYY + i] = fma(ey, dy, state[EYY + i])
        state[RED + i] = fma(weight, state[G_RED + base + i], state[RED + i])
        state[GREEN + i] = fma(weight, state[G_GREEN + base + i], state[GREEN + i])
        state[BLUE + i] = fma(weight, state[G_BLUE + base + i], state[BLUE + i])
        if grad_depth is not None:
            state[DEPTH + i] = fma(weight, state[G_DEPTH + base + i], state[DEPTH + i])
        if grad_median is not None:
            chosen = rank == state[HALVED + base + i]
            state[DEPTH + i] += state[G_MEDIAN + base + i] if chosen else ZERO


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
    transmittance,
    stops,
    halved,
    origins,
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
    row_stops = np.empty(col.TILE, np.float32)
    for tile in range(start, stop):
        picture, left, top, rows, columns = corner(tile, grid)
        state[:PIXELS] = ONE
        state[PIXELS:] = ZERO
        for row in range(rows):
            row_stops[row] = 0
            for i in range(columns):
                pixel, at_y, at_x = row * LANES + i, top + row, left + i
                left_over = transmittance[picture, at_y, at_x]
                state[pixel] = left_over
                state[BEHIND + pixel] = left_over * grad_transmittance[picture, at_y, at_x]
                state[STOP + pixel] = stops[picture, at_y, at_x]
                row_stops[row] = max(row_stops[row], stops[picture, at_y, at_x])
                state[G_RED + pixel] = grad_image[picture, 0, at_y, at_x]
                state[G_GREEN + pixel] = grad_image[picture, 1, at_y, at_x]
                state[G_BLUE + pixel] = grad_image[picture, 2, at_y, at_x]
                if grad_depth is not None:
                    state[G_DEPTH + pixel] = grad_depth[picture, at_y, at_x]
                    state[ORIGIN + pixel] = origins[picture, at_y, at_x]
                if grad_median is not None:
                    state[HALVED + pixel] = halved[picture, at_y, at_x]
                    state[G_MEDIAN + pixel] = grad_median[picture, at_y, at_x]
        begin = first_entry[tile]
        for position in range(last_entry[tile] - 1, begin - 1, -1):
            d, pair = entries[position, 0], entries[position, 1]
            prefetch(splats, entries[max(position - AHEAD, begin), 0])
            rank = np.float32(position - begin)
            x, y = center_offset(splats, bases, d, left, top)
            u0, b = whitened_start(splats, d, x, y)
            first, last = rows_in_reach(splats, d, y, rows) if skip_rows else (0, rows - 1)
            a, c, log_opacity = splats[d, col.A], splats[d, col.C], splats[d, col.LOG_OPACITY]
            color = (splats[d, col.RED], splats[d, col.GREEN], splats[d, col.BLUE])
            z, z_rest = splats[d, col.DEPTH], splats[d, col.DEPTH_REST]
            for row in range(first, last + 1):
                if skip_opaque and rank >= row_stops[row]:
                    continue
                base, dy, exponent, middle = row_of(row, y, u0, b, c, log_opacity)
                draw_row_backward(
                    state,
                    base,
                    rank,
                    dy,
                    a,
                    middle,
                    exponent,
                    color,
                    z,
                    z_rest,
                    convention,
                    grad_depth,
                    grad_median,
                )
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
