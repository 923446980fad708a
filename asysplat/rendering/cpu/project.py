"""Gaussians to splats, in float64 whatever the inputs: a splat is rounded once, at the end.

Where a Gaussian's ellipse lies is computed for a batch at a time, without a branch, so that the
compiler makes vectors of it; colors and tiles follow for what can be seen.
"""

import math
from typing import NamedTuple

import numpy as np

from asysplat.ops.simd.kernel import inline, kernel
from asysplat.rendering.cpu.math import (
    compensation,
    covariance,
    dot,
    ellipse_rows,
    in_camera,
    load_camera,
    log2,
    plus,
    row3,
    triple,
    whitening,
    write_sh_basis,
)
from asysplat.rendering.cpu.splat import RED, Ellipse, load_ellipse, store_ellipse
from asysplat.rendering.cpu.tiles import find_box, list_tiles
from asysplat.rendering.formulas import CENTER, EXPONENT_MARGIN, PIXEL_MARGIN, WHITEN_TO_LOG2
from asysplat.rendering.interface import MAX_MAGNITUDE, MIN_SQUARED_DISTANCE

# Counters of a block: tiles that boxes would touch in the place of ellipses; Gaussians that were
# culled by their opacity; those that were culled outside the image.
BOXES, FAINT, OUTSIDE = range(3)
COUNTERS = 3

BATCH = 256
# Rows [BATCH] of what `_find_ellipses` finds. SEEN is 1, or 0, or OUT_OF_IMAGE.
CENTER_X, CENTER_Y, DEPTH, WHITEN_A, WHITEN_B, WHITEN_C, LOG_OPACITY, EXTENT_X, EXTENT_Y, SEEN = (
    BATCH * row for row in range(10)
)
FOUND = 10
OUT_OF_IMAGE = -1.0


class Projected(NamedTuple):
    """What `project` writes.

    splats [images * N, 16], see `splat`, where visible; counts [images * N] pairs of splat and tile
    of each, 0 where culled; counters [images, blocks, COUNTERS]; histograms [images, blocks, tiles]
    pairs of each tile.
    """

    splats: np.ndarray
    counts: np.ndarray
    counters: np.ndarray
    histograms: np.ndarray


class _Batch(NamedTuple):
    """Gaussians side by side, flat: their fields, and their numbers within the batch."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    chosen: np.ndarray


@kernel
def project(start, stop, inputs, frame, out):
    """Find the splats of blocks start to stop, and the tiles that they touch.

    Args:
        start, stop: blocks, numbered image by image.
        inputs: `Inputs` of float32 or float64.
        frame: sizes and settings.
        out: `Projected`, written.

    Returns:
        [pairs of these blocks] int32, the tile of each, splat by splat; see `list_tiles`.
    """
    settings = frame.project
    splats, counts = out.splats, out.counts
    bases = splats.view(np.int32)
    functions = np.empty(16)
    boxes = np.empty((BATCH, 4), np.int32)
    tiles, pairs = np.empty(2 * BATCH, np.int32), 0
    found = np.empty(FOUND * BATCH)
    batch = _Batch(
        means=np.empty(3 * BATCH, inputs.means.dtype),
        quats=np.empty(4 * BATCH, inputs.quats.dtype),
        scales=np.empty(3 * BATCH, inputs.scales.dtype),
        opacities=np.empty(BATCH, inputs.opacities.dtype),
        chosen=np.empty(BATCH, np.int32),
    )
    least = settings.alpha_min if settings.cull_opacity else -np.inf
    for index in range(start, stop):
        image, block = index // frame.blocks, index % frame.blocks
        camera = load_camera(inputs.cameras, image)
        histogram = out.histograms[image, block]
        histogram[:] = 0
        last = min((block + 1) * frame.block_size, frame.num)
        faint = outside = touched = 0
        for first in range(block * frame.block_size, last, BATCH):
            length = min(BATCH, last - first)
            g, d = image // frame.views * frame.num + first, image * frame.num + first
            counts[d : d + length] = 0
            kept = _gather(inputs, g, length, least, batch)
            faint += length - kept
            _find_ellipses(kept, batch, camera, frame, found)
            in_boxes = 0
            for k in range(kept):
                if found[SEEN + k] != 1:
                    outside += found[SEEN + k] == OUT_OF_IMAGE
                    continue
                i = batch.chosen[k]
                _store_found(found, k, splats, bases, d + i)
                if not _store_color(inputs, g + i, image, functions, splats, d + i):
                    found[SEEN + k] = 0
                    continue
                ellipse = load_ellipse(splats, bases, d + i)
                in_boxes += find_box(ellipse, found[EXTENT_X + k], frame, boxes[k])
            touched += in_boxes
            if pairs + in_boxes > len(tiles):
                tiles = _enlarged(tiles, pairs, pairs + in_boxes)
            for k in range(kept):
                if found[SEEN + k] == 1:
                    i = batch.chosen[k]
                    ellipse = load_ellipse(splats, bases, d + i)
                    counts[d + i] = list_tiles(ellipse, boxes[k], frame, histogram, tiles, pairs)
                    pairs += counts[d + i]
        out.counters[image, block, BOXES] = touched
        out.counters[image, block, FAINT] = faint
        out.counters[image, block, OUTSIDE] = outside
    return tiles[:pairs]


@inline
def _enlarged(array, kept, least):
    """Copy the first `kept` numbers into at least twice the room."""
    larger = np.empty(max(2 * len(array), least), array.dtype)
    larger[:kept] = array[:kept]
    return larger


@inline
def _gather(inputs, g, length, least, batch):
    """Put those of `length` Gaussians whose opacity is not below `least` side by side.

    Return how many they are.
    """
    kept = 0
    for i in range(length):
        if inputs.opacities[g + i] < least:
            continue
        batch.chosen[kept] = i
        batch.opacities[kept] = inputs.opacities[g + i]
        for k in range(3):
            batch.means[3 * kept + k] = inputs.means[g + i, k]
            batch.scales[3 * kept + k] = inputs.scales[g + i, k]
        for k in range(4):
            batch.quats[4 * kept + k] = inputs.quats[g + i, k]
        kept += 1
    return kept


@inline
def _find_ellipses(count, batch, camera, frame, found):
    """Fill `found` for the first `count` Gaussians of a batch."""
    settings = frame.project
    opacities = batch.opacities
    alpha_min, eps = settings.alpha_min, settings.eps2d
    edge = 0.5 - PIXEL_MARGIN
    for i in range(count):
        mean = in_camera(camera, triple(batch.means, 3 * i))
        mx, my, _, _, _ = ellipse_rows(batch.quats, batch.scales, i, mean.row_x, mean.row_y)
        xx, xy, yy, _, det0, det = covariance(mx, my, eps)
        a, b, c = whitening(xy, yy + eps, det)
        opacity = float(opacities[i])
        if settings.antialiased:
            opacity *= compensation(det0, det, settings.compensation_min)
        x, y = mean.tangent_x * camera.fx + camera.cx, mean.tangent_y * camera.fy + camera.cy
        log_opacity = log2(opacity)
        room = (log_opacity if settings.own_extent else 0.0) - settings.log_alpha_min
        deviations = math.sqrt(max(room + EXPONENT_MARGIN, 0.0)) / WHITEN_TO_LOG2
        extent_x, extent_y = deviations * math.sqrt(xx + eps), deviations * math.sqrt(yy + eps)
        # Every comparison with NaN is false. Without a short cut: `and` would be a branch.
        seen = (
            (mean.z > settings.near)
            & (mean.z < MAX_MAGNITUDE)
            & (opacity >= alpha_min)
            & (float(opacities[i]) <= 1)
            & (a > 0)
            & (abs(x + y + b + c) < np.inf)
        )
        inside = (
            (x + extent_x >= edge)
            & (x - extent_x <= frame.width - edge)
            & (y + extent_y >= edge)
            & (y - extent_y <= frame.height - edge)
        )
        found[CENTER_X + i], found[CENTER_Y + i], found[DEPTH + i] = x, y, mean.z
        found[WHITEN_A + i] = a * WHITEN_TO_LOG2
        found[WHITEN_B + i] = b * WHITEN_TO_LOG2
        found[WHITEN_C + i] = c * WHITEN_TO_LOG2
        found[LOG_OPACITY + i] = log_opacity
        found[EXTENT_X + i], found[EXTENT_Y + i] = extent_x, extent_y
        shown = 1.0 if inside | (not settings.cull_frustum) else OUT_OF_IMAGE
        found[SEEN + i] = shown if seen else 0.0


@inline
def _store_found(found, i, splats, bases, d):
    """Round what was found to splat d; all but the color."""
    ellipse = Ellipse(
        x=found[CENTER_X + i],
        y=found[CENTER_Y + i],
        a=found[WHITEN_A + i],
        b=found[WHITEN_B + i],
        c=found[WHITEN_C + i],
        extent_y=found[EXTENT_Y + i],
    )
    store_ellipse(splats, bases, d, ellipse, found[LOG_OPACITY + i], found[DEPTH + i])


@inline
def _store_color(inputs, g, image, functions, splats, d):
    """Store the color of Gaussian g seen from the camera; return whether it is a usable one."""
    sh = inputs.sh
    count = sh.shape[1]
    x = y = z = 0.0
    if count > 1:
        offset = plus(row3(inputs.means, g), -1.0, row3(inputs.cameras, image, CENTER))
        length = math.sqrt(max(dot(offset, offset), MIN_SQUARED_DISTANCE))
        x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    write_sh_basis(x, y, z, count, functions)
    usable = True
    for channel in range(3):
        color = 0.5
        for k in range(count):
            coefficient = float(sh[g, k, channel])
            usable &= abs(coefficient) < MAX_MAGNITUDE
            color += functions[k] * coefficient
        splats[d, RED + channel] = max(color, 0.0)
    return usable
