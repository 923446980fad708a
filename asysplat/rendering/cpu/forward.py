"""Splats to pixels, front to back: a task draws a tile, a vector is a row of it."""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import HALF, LANES, MIDDLE, ONE, ZERO, alpha_at, fma, prefetch
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.sort import DIGITS, RADIX, sort_by_depth
from asysplat.rendering.cpu.tile import (
    AHEAD,
    CHECK,
    PIXELS,
    PLANE,
    aligned,
    center_offset,
    corner,
    is_opaque,
    row_of,
    rows_in_reach,
    whitened_start,
)

# Planes of a tile's state: what passes through; what passed where nothing may any more, and 1 + the
# rank in the list at which that was; alpha; colour; depths, and 1 + the rank of the median's.
REST, STOP, ALPHA, RED, GREEN, BLUE, DEPTH, ORIGIN, MEDIAN, HALVED = (
    plane * PLANE for plane in range(1, 11)
)
PLANES = 11

NEVER = np.float32(2.0**30)  # more than any rank


@inline
def draw_row(state, base, rank, a, middle, exponent, color, z, z_rest, convention, depth, median):
    """Blend a splat into the row that begins at `base`: alpha = 2^(exponent - u^2), where u grows
    by `a` a pixel and is `middle` in the middle."""
    alpha_min, alpha_max, transmittance_min = convention
    red, green, blue = color
    for i in range(LANES):
        u = fma(a, np.float32(i) - MIDDLE, middle)
        opacity = alpha_at(u, exponent, alpha_min, alpha_max)
        before = state[base + i]
        behind = fma(-opacity, before, before)
        keep = ONE if behind >= transmittance_min else ZERO
        weight = opacity * before * keep
        state[base + i] = behind * keep
        stops = (ONE - keep) if before > ZERO else ZERO
        state[STOP + base + i] = fma(stops, rank + ONE, state[STOP + base + i])
        state[REST + base + i] = fma(stops, before, state[REST + base + i])
        state[ALPHA + base + i] += weight
        state[RED + base + i] = fma(weight, red, state[RED + base + i])
        state[GREEN + base + i] = fma(weight, green, state[GREEN + base + i])
        state[BLUE + base + i] = fma(weight, blue, state[BLUE + base + i])
        if depth is not None:
            # From the depth of the first that shows: what is blended are small differences.
            first = ONE if before == ONE and weight > ZERO else ZERO
            origin = fma(first, z, state[ORIGIN + base + i])
            state[ORIGIN + base + i] = origin
            state[DEPTH + base + i] = fma(weight, (z - origin) + z_rest, state[DEPTH + base + i])
        if median is not None:
            halved = ONE if before > HALF and weight > ZERO and behind <= HALF else ZERO
            state[MEDIAN + base + i] = fma(halved, z, state[MEDIAN + base + i])
            state[HALVED + base + i] = fma(halved, rank + ONE, state[HALVED + base + i])


@kernel
def rasterize(
    start,
    stop,
    splats,
    first_entry,
    last_entry,
    entries,
    wanted,
    grid,
    convention,
    skips,
    image,
    alpha,
    transmittance,
    depth,
    median,
    stops,
    halved,
    origins,
    counters,
):
    """Sort and draw tiles start to stop.

    Args:
        splats: [images * N, 16], see `layout`.
        first_entry: [tiles + 1] where each tile's list begins.
        last_entry: [tiles] is set to where it was left, all its pixels being opaque.
        entries: [pairs, 2] splat and pair of each; sorted in place.
        wanted: [tiles] whether to draw it.
        grid: columns of tiles, tiles of an image, height, width.
        convention: alpha_min, alpha_max, transmittance_min, float32.
        skips: whether to skip rows out of reach, and those that are opaque.
        image: [images, 3, H, W]; alpha, transmittance, depth, median: [images, H, W], of which the
            last two may be None: then they cost nothing. Every pixel is written.
        stops: [images, H, W] the rank in its list of the splat that a pixel dropped, and all behind
            it; NEVER where it dropped none.
        halved: [images, H, W] the rank of the splat of the median depth, -1 without one; None
            where `median` is.
        origins: [images, H, W] the depth that those in `depth` are taken from; None where it is.
        counters: [tiles, COUNTERS].
    """
    skip_rows, skip_opaque = skips
    bases = splats.view(np.int32)
    longest = 0
    for tile in range(start, stop):
        longest = max(longest, first_entry[tile + 1] - first_entry[tile])
    keys = np.empty((2, longest), np.uint32)
    scratch = np.empty((2, longest, 2), entries.dtype)
    digits = np.empty((DIGITS, RADIX), np.int64)
    state = aligned(PLANES * PLANE)
    for tile in range(start, stop):
        picture, left, top, rows, columns = corner(tile, grid)
        position, end = first_entry[tile], first_entry[tile + 1]
        if not wanted[tile]:
            end = position
        sort_by_depth(entries, position, end, splats, keys, scratch, digits)
        state[:PIXELS] = ONE
        state[PIXELS:] = ZERO
        live = (1 << rows) - 1
        in_reach = drawn = 0
        while position < end and live:
            d = entries[position, 0]
            prefetch(splats, entries[min(position + AHEAD, end - 1), 0])
            look = skip_opaque and position & CHECK == CHECK
            rank = np.float32(position - first_entry[tile])
            position += 1
            x, y = center_offset(splats, bases, d, left, top)
            u0, b = whitened_start(splats, d, x, y)
            first, last = rows_in_reach(splats, d, y, rows) if skip_rows else (0, rows - 1)
            a, c, log_opacity = splats[d, col.A], splats[d, col.C], splats[d, col.LOG_OPACITY]
            color = (splats[d, col.RED], splats[d, col.GREEN], splats[d, col.BLUE])
            z, z_rest = splats[d, col.DEPTH], splats[d, col.DEPTH_REST]
            in_reach += last - first + 1
            for row in range(first, last + 1):
                if not (live >> row) & 1:
                    continue
                drawn += 1
                base, _, exponent, middle = row_of(row, y, u0, b, c, log_opacity)
                draw_row(
                    state,
                    base,
                    rank,
                    a,
                    middle,
                    exponent,
                    color,
                    z,
                    z_rest,
                    convention,
                    depth,
                    median,
                )
                if look and is_opaque(state, base):
                    live &= ~(1 << row)
        last_entry[tile] = position
        counters[tile, col.ROWS_IN_REACH] = in_reach
        counters[tile, col.ROWS] = drawn
        for row in range(rows):
            for i in range(columns):
                pixel = row * LANES + i
                alpha[picture, top + row, left + i] = state[ALPHA + pixel]
                transmittance[picture, top + row, left + i] = state[pixel] + state[REST + pixel]
                image[picture, 0, top + row, left + i] = state[RED + pixel]
                image[picture, 1, top + row, left + i] = state[GREEN + pixel]
                image[picture, 2, top + row, left + i] = state[BLUE + pixel]
                if depth is not None:
                    depth[picture, top + row, left + i] = state[DEPTH + pixel]
                    origins[picture, top + row, left + i] = state[ORIGIN + pixel]
                if median is not None:
                    median[picture, top + row, left + i] = state[MEDIAN + pixel]
                    halved[picture, top + row, left + i] = state[HALVED + pixel] - ONE
                stop_rank = state[STOP + pixel] - ONE
                stops[picture, top + row, left + i] = stop_rank if stop_rank >= ZERO else NEVER
