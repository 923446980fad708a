"""Gaussians to splats, in float64 whatever the inputs: a splat is rounded once, at the end.

Where a Gaussian's ellipse lies is computed for a batch at a time, without a branch, so that the
compiler makes vectors of it; colours and tiles follow for what can be seen.
"""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import log2
from asysplat.rendering import camera_rows as cam
from asysplat.rendering.convention import LARGEST
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.geometry import (
    clamp,
    compensation,
    covariance,
    ellipse_rows,
    jacobian_row,
    whitening,
)
from asysplat.rendering.cpu.sh import basis
from asysplat.rendering.cpu.tiles import find_box, list_tiles
from asysplat.rendering.cpu.vectors import dot, plus, row3, triple
from asysplat.rendering.formulas import WHITEN_TO_LOG2

TINY = 1e-20  # below the square of any distance that matters

BATCH = 256
# Rows [BATCH] of what `_ellipses` finds; SEEN is 1, OUTSIDE the image, or 0.
CENTER_X, CENTER_Y, DEPTH, WHITEN_A, WHITEN_B, WHITEN_C, LOG_OPACITY, REACH_X, REACH_Y, SEEN = (
    BATCH * row for row in range(10)
)
FOUND = 10
OUTSIDE = -1.0


@kernel
def project(
    start,
    stop,
    means,
    quats,
    scales,
    opacities,
    sh,
    cameras,
    views,
    block_size,
    size,
    convention,
    antialiased,
    skips,
    splats,
    counts,
    counters,
    histograms,
):
    """Splats of blocks start to stop, and the tiles that they touch.

    Args:
        means, quats, scales, opacities, sh: [B * N, ...].
        cameras: [B * V, 20] float64, views: V.
        block_size: Gaussians of a block.
        size: height and width in pixels, columns in tiles.
        convention: alpha_min, log2(alpha_min), eps2d, near, compensation_min.
        skips: whether to use the culls by opacity and frustum, the opacity's extent, the ellipse.
        splats: [B * V * N, 16], written where visible.
        counts: [B * V * N] pairs of each, 0 where culled.
        counters: [B * V, blocks, PROJECT_COUNTERS], see `layout`.
        histograms: [B * V, blocks, tiles] pairs of each tile.

    Returns:
        [pairs of these blocks] int32, the tile of each, splat by splat; see `list_tiles`.
    """
    alpha_min = convention[0]
    skip_opacity, skip_frustum, own_extent, exact = skips
    bases = splats.view(np.int32)
    blocks = histograms.shape[1]
    images = cameras.shape[0]
    num = splats.shape[0] // images
    functions = np.empty(16)
    boxes = np.empty((BATCH, 4), np.int32)
    tiles, pairs = np.empty(2 * BATCH, np.int32), 0
    found = np.empty(FOUND * BATCH)
    chosen = np.empty(BATCH, np.int32)
    some_means, some_scales = np.empty(3 * BATCH, means.dtype), np.empty(3 * BATCH, scales.dtype)
    some_quats, some_opacities = np.empty(4 * BATCH, quats.dtype), np.empty(BATCH, opacities.dtype)
    for index in range(start, stop):
        image, block = index // blocks, index % blocks
        histogram = histograms[image, block]
        histogram[:] = 0
        last = min((block + 1) * block_size, num)
        faint = outside = touched = 0
        for first in range(block * block_size, last, BATCH):
            length = min(BATCH, last - first)
            g, d = image // views * num + first, image * num + first
            counts[d : d + length] = 0
            kept = _gather(
                g, length, alpha_min if skip_opacity else -np.inf, means, quats, scales, opacities,
                chosen, some_means, some_quats, some_scales, some_opacities,
            )  # fmt: skip
            faint += length - kept
            _ellipses(
                kept, some_means, some_quats, some_scales, some_opacities, cameras[image], size,
                convention, antialiased, skip_frustum, own_extent, found,
            )  # fmt: skip
            in_boxes = 0
            for k in range(kept):
                if found[SEEN + k] != 1:
                    outside += found[SEEN + k] == OUTSIDE
                    continue
                i = chosen[k]
                _write_ellipse(found, k, splats, bases, d + i)
                if not _write_color(g + i, d + i, means, sh, cameras, image, functions, splats):
                    found[SEEN + k] = 0
                    continue
                in_boxes += find_box(splats, bases, d + i, found[REACH_X + k], size, boxes[k])
            touched += in_boxes
            if pairs + in_boxes > len(tiles):
                tiles = _enlarged(tiles, pairs, pairs + in_boxes)
            for k in range(kept):
                if found[SEEN + k] == 1:
                    i = chosen[k]
                    counts[d + i] = list_tiles(
                        splats, bases, d + i, boxes[k], size, exact, histogram, tiles, pairs
                    )
                    pairs += counts[d + i]
        counters[image, block, col.BOXES] = touched
        counters[image, block, col.FAINT] = faint
        counters[image, block, col.OUTSIDE] = outside
    return tiles[:pairs]


@inline
def _enlarged(array, kept, least):
    """A copy of the first `kept` numbers in at least twice the room."""
    larger = np.empty(max(2 * len(array), least), array.dtype)
    larger[:kept] = array[:kept]
    return larger


@inline
def _gather(
    g, length, least, means, quats, scales, opacities,
    chosen, some_means, some_quats, some_scales, some_opacities,
):  # fmt: skip
    """Put the Gaussians whose opacity is not below `least` side by side; how many they are."""
    kept = 0
    for i in range(length):
        if opacities[g + i] < least:
            continue
        chosen[kept] = i
        some_opacities[kept] = opacities[g + i]
        for k in range(3):
            some_means[3 * kept + k] = means[g + i, k]
            some_scales[3 * kept + k] = scales[g + i, k]
        for k in range(4):
            some_quats[4 * kept + k] = quats[g + i, k]
        kept += 1
    return kept


@inline
def _ellipses(
    count, means, quats, scales, opacities, camera, size,
    convention, antialiased, skip_frustum, own_extent, found,
):  # fmt: skip
    """Fill `found` for the first `count` Gaussians of flat arrays."""
    alpha_min, log_alpha_min, eps, near, compensation_min = convention
    height, width, _ = size
    right, down = triple(camera, cam.RIGHT), triple(camera, cam.DOWN)
    forward, center = triple(camera, cam.FORWARD), triple(camera, cam.CENTER)
    fx, fy, cx, cy = camera[cam.FX], camera[cam.FY], camera[cam.CX], camera[cam.CY]
    low_x, high_x = camera[cam.LOW_X], camera[cam.HIGH_X]
    low_y, high_y = camera[cam.LOW_Y], camera[cam.HIGH_Y]
    edge = 0.5 - col.PIXEL_MARGIN
    for i in range(count):
        # Relative to the camera first: exact for scenes far from the origin.
        offset = plus(triple(means, 3 * i), -1.0, center)
        z = dot(forward, offset)
        inverse_z = 1 / z
        tangent_x, tangent_y = dot(right, offset) * inverse_z, dot(down, offset) * inverse_z
        inside_x, inside_y = clamp(tangent_x, low_x, high_x), clamp(tangent_y, low_y, high_y)
        row_x = jacobian_row(right, forward, fx, inverse_z, inside_x)
        row_y = jacobian_row(down, forward, fy, inverse_z, inside_y)
        mx, my, _, _, _ = ellipse_rows(quats, scales, i, row_x, row_y)
        xx, xy, yy, _, det0, det = covariance(mx, my, eps)
        a, b, c = whitening(xy, yy + eps, det)
        opacity = float(opacities[i])
        if antialiased:
            opacity *= compensation(det0, det, compensation_min)
        x, y = tangent_x * fx + cx, tangent_y * fy + cy
        log_opacity = log2(opacity)
        room = (log_opacity if own_extent else 0.0) - log_alpha_min + col.EXPONENT_MARGIN
        reach = math.sqrt(max(room, 0.0)) / WHITEN_TO_LOG2
        reach_x, reach_y = reach * math.sqrt(xx + eps), reach * math.sqrt(yy + eps)
        # Every comparison with NaN is false. Without a short cut: `and` would be a branch.
        seen = (
            (z > near)
            & (z < LARGEST)
            & (opacity >= alpha_min)
            & (float(opacities[i]) <= 1)
            & (a > 0)
            & (abs(x + y + b + c) < np.inf)
        )
        inside = (
            (x + reach_x >= edge)
            & (x - reach_x <= width - edge)
            & (y + reach_y >= edge)
            & (y - reach_y <= height - edge)
        )
        found[CENTER_X + i], found[CENTER_Y + i], found[DEPTH + i] = x, y, z
        found[WHITEN_A + i] = a * WHITEN_TO_LOG2
        found[WHITEN_B + i] = b * WHITEN_TO_LOG2
        found[WHITEN_C + i] = c * WHITEN_TO_LOG2
        found[LOG_OPACITY + i] = log_opacity
        found[REACH_X + i], found[REACH_Y + i] = reach_x, reach_y
        shown = 1.0 if inside | (not skip_frustum) else OUTSIDE
        found[SEEN + i] = shown if seen else 0.0


@inline
def _write_ellipse(found, i, splats, bases, d):
    """Round to a splat; all but the colour."""
    x, y, z = found[CENTER_X + i], found[CENTER_Y + i], found[DEPTH + i]
    a, b = found[WHITEN_A + i], found[WHITEN_B + i]
    base_x = min(max(np.floor(x), -col.FARTHEST), col.FARTHEST)
    base_y = min(max(np.floor(y), -col.FARTHEST), col.FARTHEST)
    bases[d, col.BASE_X], bases[d, col.BASE_Y] = np.int32(base_x), np.int32(base_y)
    splats[d, col.X], splats[d, col.Y] = x - base_x, y - base_y
    splats[d, col.A], splats[d, col.B] = a, b
    splats[d, col.A_REST] = a - float(np.float32(a))
    splats[d, col.B_REST] = b - float(np.float32(b))
    splats[d, col.C] = found[WHITEN_C + i]
    splats[d, col.LOG_OPACITY] = found[LOG_OPACITY + i]
    splats[d, col.DEPTH] = z
    splats[d, col.DEPTH_REST] = z - float(np.float32(z))
    splats[d, col.REACH_Y] = min(found[REACH_Y + i] * (1 + 1e-6), col.FARTHEST)


@inline
def _write_color(g, d, means, sh, cameras, image, functions, splats):
    """The colour seen from the camera; False, and the splat is culled, where it is not usable."""
    count = sh.shape[1]
    x = y = z = 0.0
    if count > 1:
        offset = plus(row3(means, g), -1.0, row3(cameras, image, cam.CENTER))
        length = math.sqrt(max(dot(offset, offset), TINY))
        x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    basis(x, y, z, count, functions)
    usable = True
    for channel in range(3):
        color = 0.5
        for k in range(count):
            coefficient = float(sh[g, k, channel])
            usable &= abs(coefficient) < LARGEST
            color += functions[k] * coefficient
        splats[d, col.RED + channel] = max(color, 0.0)
    return usable
