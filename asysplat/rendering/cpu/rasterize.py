"""Rasterize splats and compute their gradients: a task takes a tile, a vector is a row of it.

The forward pass blends front to back. The backward pass goes back to front: it sums up the light
from behind a splat, from small terms to large ones, so that nothing cancels. The transmittance in
front of a splat is the one behind it over 1 - alpha, which keeps its relative precision. The
forward pass saves where each pixel stopped. Each pair of splat and tile has its own gradient:
threads never write to the same one, and sums have a fixed order.

Products and sums are fused by name and never by the compiler's choice, so that both passes, which
share the deciding functions, take identical decisions.
"""

from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.threads import inline, kernel
from asysplat.kernels.simd.vectors import LANES, ONE, ZERO, exp2, fma
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.math import sum_and_clear, to_bits
from asysplat.rendering.cpu.splat import (
    HALF,
    MIDDLE,
    TILE,
    load_splat,
    prefetch,
    splat_in_row,
    tile_window,
    visible_rows,
)
from asysplat.rendering.cpu.tiles import DIGITS, RADIX, sort_by_depth

PIXELS = TILE * LANES
# Distance of two planes of a tile's state; 4096 bytes would alias in the processor's store buffer.
PLANE = PIXELS + LANES
PREFETCH_DISTANCE = 4  # splats
OPAQUE_MASK = 15  # rows are tested for opacity after every 16 splats
MIN_EXPONENT = np.float32(-64)  # 2 ** -64 is below every threshold and a normal number
NO_STOP = np.float32(2.0**30)  # more than any rank

# Counters of a tile: drawn rows of splats, and those within the extent, opaque rows included.
ROWS, ROWS_IN_EXTENT = range(2)
COUNTERS = 2

# Planes of a tile's state in the forward pass: the transmittance, at 0; the final transmittance of
# stopped pixels, and 1 + the rank of the stop; alpha; color; depths, and 1 + the median's rank.
STOPPED, STOP, ALPHA, RED, GREEN, BLUE, DEPTH, ORIGIN, MEDIAN, MEDIAN_RANK = (
    plane * PLANE for plane in range(1, 11)
)
STATE = 11 * PLANE

# Planes in the backward pass: the transmittance, at 0; the light from behind, the background
# included, times its gradient; the stop's rank; the depth's origin; the median's rank; gradients of
# the pixel.
G_BEHIND, G_STOP, G_ORIGIN, G_MEDIAN_RANK, G_RED, G_GREEN, G_BLUE, G_DEPTH, G_MEDIAN = (
    plane * PLANE for plane in range(1, 10)
)
# Then sums over the rows of a splat, for each column: of the exponent's gradient e, of e u, e u y,
# e y, e y^2, e u x, and of the values' gradients.
SUM_E, SUM_EU, SUM_EUY, SUM_EY, SUM_EYY, SUM_EUX, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH = (
    10 * PLANE + k * LANES for k in range(10)
)
BACKWARD_STATE = 10 * PLANE + 10 * LANES


class OutputImages(NamedTuple):
    """Image [images, 3, H, W] and alpha [images, H, W]."""

    image: np.ndarray
    alpha: np.ndarray


class SavedForBackward(NamedTuple):
    """What `rasterize` saves for `rasterize_backward`.

    A stop is the rank in the list of the first splat that a pixel dropped, NO_STOP for none. A
    tile's list is left at its last entry, where all its pixels were opaque.
    """

    transmittance: np.ndarray  # [images, H, W]
    stop_ranks: np.ndarray  # [images, H, W]
    last_entry: np.ndarray  # [tiles]
    counters: np.ndarray  # [tiles, COUNTERS]


class BlendedDepth(NamedTuple):
    """Depth [images, H, W], or its gradient, and the origins [images, H, W] it is relative to."""

    depth: np.ndarray
    origins: np.ndarray


class MedianDepth(NamedTuple):
    """Depth [images, H, W], or its gradient, and the rank of its splat, -1 without one."""

    depth: np.ndarray
    ranks: np.ndarray


class Gradients(NamedTuple):
    """Gradients of image, transmittance and pairs [pairs, 10], see `splat`."""

    image: np.ndarray
    transmittance: np.ndarray
    pairs: np.ndarray


@inline
def allocate_aligned(count):
    """Allocate float32 from the start of a cache line, so that no vector straddles two."""
    memory = np.empty(count + 16, np.float32)
    return memory[((-memory.ctypes.data) & 63) // 4 :]


@inline
def alpha_at(u, row_exponent, settings):
    """Compute the alpha of a pixel, 2^(row_exponent - u^2), 0 below alpha_min."""
    exponent = max(fma(-u, u, row_exponent), MIN_EXPONENT)
    alpha = min(exp2(exponent), settings.alpha_max)
    return alpha if alpha >= settings.alpha_min else ZERO


@inline
def is_opaque(state, base):
    """Check whether all pixels of the row that begins at `base` are opaque."""
    any_left = np.int32(0)
    for i in range(LANES):
        any_left |= to_bits(state[base + i])
    return any_left == 0


@inline
def draw_row(state, row, rank, splat, settings, blended, median):
    """Blend a splat into a row: alpha = 2^(exponent - u^2), where u grows by `a` a pixel."""
    base = row.base
    for i in range(LANES):
        u = fma(splat.a, np.float32(i) - MIDDLE, row.middle)
        opacity = alpha_at(u, row.exponent, settings)
        before = state[base + i]
        transmitted = fma(-opacity, before, before)
        keep = ONE if transmitted >= settings.transmittance_min else ZERO
        weight = opacity * before * keep
        state[base + i] = transmitted * keep
        stops = (ONE - keep) if before > ZERO else ZERO
        state[STOP + base + i] = fma(stops, rank + ONE, state[STOP + base + i])
        state[STOPPED + base + i] = fma(stops, before, state[STOPPED + base + i])
        state[ALPHA + base + i] += weight
        state[RED + base + i] = fma(weight, splat.red, state[RED + base + i])
        state[GREEN + base + i] = fma(weight, splat.green, state[GREEN + base + i])
        state[BLUE + base + i] = fma(weight, splat.blue, state[BLUE + base + i])
        if blended is not None:
            # Relative to the first visible depth: the blended differences are small.
            first = ONE if before == ONE and weight > ZERO else ZERO
            origin = fma(first, splat.z, state[ORIGIN + base + i])
            state[ORIGIN + base + i] = origin
            dz = (splat.z - origin) + splat.z_rest
            state[DEPTH + base + i] = fma(weight, dz, state[DEPTH + base + i])
        if median is not None:
            crosses_half = ONE if before > HALF and weight > ZERO and transmitted <= HALF else ZERO
            state[MEDIAN + base + i] = fma(crosses_half, splat.z, state[MEDIAN + base + i])
            state[MEDIAN_RANK + base + i] = fma(
                crosses_half, rank + ONE, state[MEDIAN_RANK + base + i]
            )


@kernel
def rasterize(start, stop, lists, frame, images, saved, blended, median):
    """Sort and draw tiles start to stop, numbered image by image.

    Every element of `images`, `saved` and, unless None, of `blended` and `median` is written.
    """
    settings = frame.raster
    splats, first_entry, entries = lists.splats, lists.first_entry, lists.entries
    bases = splats.view(np.int32)
    longest = 0
    for tile in range(start, stop):
        longest = max(longest, first_entry[tile + 1] - first_entry[tile])
    keys = np.empty((2, longest), np.uint32)
    scratch = np.empty((2, longest, 2), entries.dtype)
    digits = np.empty((DIGITS, RADIX), np.int64)
    state = allocate_aligned(STATE)
    for tile in range(start, stop):
        window = tile_window(tile, frame)
        rows = window.rows
        position, end = first_entry[tile], first_entry[tile + 1]
        if not lists.active[tile]:
            end = position
        sort_by_depth(lists, position, end, keys, scratch, digits)
        state[:PIXELS] = ONE
        state[PIXELS:] = ZERO
        live = (1 << rows) - 1
        in_extent = count = 0
        while position < end and live:
            d = entries[position, 0]
            prefetch(splats, entries[min(position + PREFETCH_DISTANCE, end - 1), 0])
            test_opacity = settings.cull_opaque and position & OPAQUE_MASK == OPAQUE_MASK
            rank = np.float32(position - first_entry[tile])
            position += 1
            splat = load_splat(splats, bases, d, window)
            first, last = 0, rows - 1
            if settings.cull_rows:
                first, last = visible_rows(splats, d, splat.y, rows)
            in_extent += last - first + 1
            for index in range(first, last + 1):
                if not (live >> index) & 1:
                    continue
                count += 1
                row = splat_in_row(splat, index)
                draw_row(state, row, rank, splat, settings, blended, median)
                if test_opacity and is_opaque(state, row.base):
                    live &= ~(1 << index)
        saved.last_entry[tile] = position
        saved.counters[tile, ROWS_IN_EXTENT] = in_extent
        saved.counters[tile, ROWS] = count
        image, left, top = window.image, window.left, window.top
        for index in range(rows):
            for i in range(window.columns):
                pixel, y, x = index * LANES + i, top + index, left + i
                images.alpha[image, y, x] = state[ALPHA + pixel]
                saved.transmittance[image, y, x] = state[pixel] + state[STOPPED + pixel]
                images.image[image, 0, y, x] = state[RED + pixel]
                images.image[image, 1, y, x] = state[GREEN + pixel]
                images.image[image, 2, y, x] = state[BLUE + pixel]
                if blended is not None:
                    blended.depth[image, y, x] = state[DEPTH + pixel]
                    blended.origins[image, y, x] = state[ORIGIN + pixel]
                if median is not None:
                    median.depth[image, y, x] = state[MEDIAN + pixel]
                    median.ranks[image, y, x] = state[MEDIAN_RANK + pixel] - ONE
                stop_rank = state[STOP + pixel] - ONE
                saved.stop_ranks[image, y, x] = stop_rank if stop_rank >= ZERO else NO_STOP


@inline
def draw_row_backward(state, row, rank, splat, settings, blended, median):
    """Add the gradients of a splat in a row to their sums; see `draw_row`."""
    base = row.base
    for i in range(LANES):
        u = fma(splat.a, np.float32(i) - MIDDLE, row.middle)
        opacity = alpha_at(u, row.exponent, settings)
        opacity = opacity if rank < state[G_STOP + base + i] else ZERO
        factor = ONE - opacity
        inverse = ONE / factor
        after = state[base + i]
        before = after * inverse
        before = fma(fma(-before, factor, after), inverse, before)  # to the last bit
        weight = opacity * before
        state[base + i] = before
        value = splat.red * state[G_RED + base + i]
        value = fma(splat.green, state[G_GREEN + base + i], value)
        value = fma(splat.blue, state[G_BLUE + base + i], value)
        if blended is not None:
            dz = (splat.z - state[G_ORIGIN + base + i]) + splat.z_rest
            value = fma(dz, state[G_DEPTH + base + i], value)
        light_behind = state[G_BEHIND + base + i]
        state[G_BEHIND + base + i] = fma(weight, value, light_behind)
        unclamped = ONE if opacity < settings.alpha_max else ZERO  # a clamped alpha is constant
        e = unclamped * fma(weight, value, -opacity * inverse * light_behind)
        eu, ey = e * u, e * row.dy
        state[SUM_E + i] += e
        state[SUM_EU + i] += eu
        state[SUM_EUY + i] = fma(eu, row.dy, state[SUM_EUY + i])
        state[SUM_EY + i] += ey
        state[SUM_EYY + i] = fma(ey, row.dy, state[SUM_EYY + i])
        state[SUM_RED + i] = fma(weight, state[G_RED + base + i], state[SUM_RED + i])
        state[SUM_GREEN + i] = fma(weight, state[G_GREEN + base + i], state[SUM_GREEN + i])
        state[SUM_BLUE + i] = fma(weight, state[G_BLUE + base + i], state[SUM_BLUE + i])
        if blended is not None:
            state[SUM_DEPTH + i] = fma(weight, state[G_DEPTH + base + i], state[SUM_DEPTH + i])
        if median is not None:
            chosen = rank == state[G_MEDIAN_RANK + base + i]
            state[SUM_DEPTH + i] += state[G_MEDIAN + base + i] if chosen else ZERO


@kernel
def rasterize_backward(start, stop, lists, frame, saved, grads, blended, median):
    """Compute the gradients of every pair in tiles start to stop.

    blended and median hold the gradient of the depth, and the other field from `rasterize`.
    """
    settings = frame.raster
    splats, first_entry, entries = lists.splats, lists.first_entry, lists.entries
    bases = splats.view(np.int32)
    state = allocate_aligned(BACKWARD_STATE)
    row_stops = np.empty(TILE, np.float32)
    for tile in range(start, stop):
        window = tile_window(tile, frame)
        image, rows = window.image, window.rows
        state[:PIXELS] = ONE
        state[PIXELS:] = ZERO
        for index in range(rows):
            row_stops[index] = 0
            for i in range(window.columns):
                pixel, y, x = index * LANES + i, window.top + index, window.left + i
                left_over = saved.transmittance[image, y, x]
                state[pixel] = left_over
                state[G_BEHIND + pixel] = left_over * grads.transmittance[image, y, x]
                state[G_STOP + pixel] = saved.stop_ranks[image, y, x]
                row_stops[index] = max(row_stops[index], saved.stop_ranks[image, y, x])
                state[G_RED + pixel] = grads.image[image, 0, y, x]
                state[G_GREEN + pixel] = grads.image[image, 1, y, x]
                state[G_BLUE + pixel] = grads.image[image, 2, y, x]
                if blended is not None:
                    state[G_DEPTH + pixel] = blended.depth[image, y, x]
                    state[G_ORIGIN + pixel] = blended.origins[image, y, x]
                if median is not None:
                    state[G_MEDIAN_RANK + pixel] = median.ranks[image, y, x]
                    state[G_MEDIAN + pixel] = median.depth[image, y, x]
        begin = first_entry[tile]
        for position in range(saved.last_entry[tile] - 1, begin - 1, -1):
            d, pair = entries[position, 0], entries[position, 1]
            prefetch(splats, entries[max(position - PREFETCH_DISTANCE, begin), 0])
            rank = np.float32(position - begin)
            splat = load_splat(splats, bases, d, window)
            first, last = 0, rows - 1
            if settings.cull_rows:
                first, last = visible_rows(splats, d, splat.y, rows)
            for index in range(first, last + 1):
                if settings.cull_opaque and rank >= row_stops[index]:
                    continue
                row = splat_in_row(splat, index)
                draw_row_backward(state, row, rank, splat, settings, blended, median)
            for i in range(LANES):
                state[SUM_EUX + i] = state[SUM_EU + i] * (
                    np.float32(splat.x) + (np.float32(i) - MIDDLE)
                )
            a, c = splat.a, splat.c
            eu, ey = sum_and_clear(state, SUM_EU), sum_and_clear(state, SUM_EY)
            # The exponent is LOG_OPACITY - u^2 - v^2; u = A x + B y, v = C y, x and y of the pixel
            # relative to the center.
            grad = grads.pairs[pair]
            grad[col.G_X] = 2 * a * eu
            grad[col.G_Y] = np.float32(2 * splat.b) * eu + 2 * c * c * ey
            grad[col.G_A] = -2 * sum_and_clear(state, SUM_EUX)
            grad[col.G_B] = -2 * sum_and_clear(state, SUM_EUY)
            grad[col.G_C] = -2 * c * sum_and_clear(state, SUM_EYY)
            grad[col.G_LOG_OPACITY] = sum_and_clear(state, SUM_E)
            grad[col.G_RED] = sum_and_clear(state, SUM_RED)
            grad[col.G_GREEN] = sum_and_clear(state, SUM_GREEN)
            grad[col.G_BLUE] = sum_and_clear(state, SUM_BLUE)
            grad[col.G_DEPTH] = sum_and_clear(state, SUM_DEPTH)
        for position in range(saved.last_entry[tile], first_entry[tile + 1]):
            grads.pairs[entries[position, 1]] = ZERO
