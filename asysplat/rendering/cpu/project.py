"""Project Gaussians to splats in float64, whatever the inputs' type; a splat is rounded once.

Ellipses are computed for a batch at a time and without branches, so that the compiler vectorizes;
colors and tiles follow for the visible Gaussians.
"""

import math
from typing import NamedTuple

import numpy as np

from asysplat.geometry.spherical_harmonics import MIN_SQUARED_DISTANCE
from asysplat.kernels.simd.threads import inline, kernel
from asysplat.rendering.cpu.math import (
    covariance,
    dot,
    ellipse_rows,
    load_camera,
    log2,
    plus,
    project_mean,
    triple,
    unit_quaternion,
    whitening,
    write_sh_basis,
)
from asysplat.rendering.cpu.splat import RED, Ellipse, load_ellipse, store_ellipse
from asysplat.rendering.cpu.tiles import compute_box, list_tiles
from asysplat.rendering.formulas import CENTER, EXPONENT_MARGIN, PIXEL_MARGIN, WHITEN_TO_LOG2
from asysplat.rendering.interface import MAX_MAGNITUDE

# Counters of a block: tiles that the splats' boxes touch; Gaussians culled by each.
BOX_TILES, CULLED_BY_OPACITY, CULLED_BY_FRUSTUM = range(3)
COUNTERS = 3

BATCH = 256
# Rows [BATCH] of a batch's ellipses. STATUS is VISIBLE, CULLED or OUTSIDE_IMAGE.
CENTER_X, CENTER_Y, DEPTH, WHITEN_A, WHITEN_B, WHITEN_C, LOG_OPACITY, EXTENT_X, EXTENT_Y, STATUS = (
    BATCH * row for row in range(10)
)
ELLIPSE_ROWS = 10
VISIBLE, CULLED, OUTSIDE_IMAGE = 1.0, 0.0, -1.0


class Projected(NamedTuple):
    """The outputs of `project`."""

    splats: np.ndarray  # [images * N, 16], see `splat`, written where visible
    counts: np.ndarray  # [images * N] pairs of splat and tile, 0 where culled
    counters: np.ndarray  # [images, blocks, COUNTERS]
    histograms: np.ndarray  # [images, blocks, tiles] pairs of each tile


class _Batch(NamedTuple):
    """Flat arrays of the fields of a batch's Gaussians, and their indices within the batch."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    indices: np.ndarray


@kernel
def project(start, stop, inputs, frame, out):
    """Compute the splats of blocks start to stop, numbered image by image, and their tiles.

    Return the tile of each pair of these blocks, int32, splat by splat; see `list_tiles`.
    """
    settings = frame.project
    splats, counts = out.splats, out.counts
    bases = splats.view(np.int32)
    basis = np.empty(16)
    boxes = np.empty((BATCH, 4), np.int32)
    tiles, pairs = np.empty(2 * BATCH, np.int32), 0
    ellipses = np.empty(ELLIPSE_ROWS * BATCH)
    batch = _Batch(
        means=np.empty(3 * BATCH, inputs.means.dtype),
        quats=np.empty(4 * BATCH, inputs.quats.dtype),
        scales=np.empty(3 * BATCH, inputs.scales.dtype),
        opacities=np.empty(BATCH, inputs.opacities.dtype),
        indices=np.empty(BATCH, np.int32),
    )
    min_opacity = settings.alpha_min if settings.cull_opacity else -np.inf
    for index in range(start, stop):
        image, block = index // frame.blocks, index % frame.blocks
        camera = load_camera(inputs.cameras, image)
        histogram = out.histograms[image, block]
        histogram[:] = 0
        last = min((block + 1) * frame.block_size, frame.num)
        culled_by_opacity = culled_by_frustum = box_tiles = 0
        for first in range(block * frame.block_size, last, BATCH):
            length = min(BATCH, last - first)
            g, d = image // frame.views * frame.num + first, image * frame.num + first
            counts[d : d + length] = 0
            size = _gather(inputs, g, length, min_opacity, batch)
            culled_by_opacity += length - size
            _project_batch(size, batch, camera, frame, ellipses)
            batch_tiles = 0
            for k in range(size):
                if ellipses[STATUS + k] != VISIBLE:
                    culled_by_frustum += ellipses[STATUS + k] == OUTSIDE_IMAGE
                    continue
                i = batch.indices[k]
                _store_ellipse(ellipses, k, splats, bases, d + i)
                if not _store_color(inputs, g + i, image, basis, splats, d + i):
                    ellipses[STATUS + k] = CULLED
                    continue
                ellipse = load_ellipse(splats, bases, d + i)
                batch_tiles += compute_box(ellipse, ellipses[EXTENT_X + k], frame, boxes[k])
            box_tiles += batch_tiles
            if pairs + batch_tiles > len(tiles):
                tiles = _grow(tiles, pairs, pairs + batch_tiles)
            for k in range(size):
                if ellipses[STATUS + k] == VISIBLE:
                    i = batch.indices[k]
                    ellipse = load_ellipse(splats, bases, d + i)
                    counts[d + i] = list_tiles(ellipse, boxes[k], frame, histogram, tiles, pairs)
                    pairs += counts[d + i]
        out.counters[image, block, BOX_TILES] = box_tiles
        out.counters[image, block, CULLED_BY_OPACITY] = culled_by_opacity
        out.counters[image, block, CULLED_BY_FRUSTUM] = culled_by_frustum
    return tiles[:pairs]


@inline
def _grow(array, size, min_opacity):
    """Copy the first `size` numbers into an array of at least twice the length."""
    larger = np.empty(max(2 * len(array), min_opacity), array.dtype)
    larger[:size] = array[:size]
    return larger


@inline
def _gather(inputs, g, length, min_opacity, batch):
    """Copy Gaussians of at least `min_opacity` into the batch; return their number."""
    size = 0
    for i in range(length):
        if inputs.opacities[g + i] < min_opacity:
            continue
        batch.indices[size] = i
        batch.opacities[size] = inputs.opacities[g + i]
        for k in range(3):
            batch.means[3 * size + k] = inputs.means[g + i, k]
            batch.scales[3 * size + k] = inputs.scales[g + i, k]
        for k in range(4):
            batch.quats[4 * size + k] = inputs.quats[g + i, k]
        size += 1
    return size


@inline
def _project_batch(count, batch, camera, frame, ellipses):
    """Compute the ellipses of the first `count` Gaussians of a batch."""
    settings = frame.project
    opacities = batch.opacities
    alpha_min, eps = settings.alpha_min, settings.eps2d
    axes, center, focal, limits, principal = camera
    edge = 0.5 - PIXEL_MARGIN
    for i in range(count):
        _, z, _, tangents, _, row_x, row_y = project_mean(
            triple(batch.means, 3 * i), axes, center, focal, limits
        )
        quat, scale = unit_quaternion(batch.quats, 4 * i), triple(batch.scales, 3 * i)
        mx, my, _, _ = ellipse_rows(quat, scale, row_x, row_y)
        xx, xy, yy, _, det0, det = covariance(mx, my, eps)
        a, b, c = whitening(xy, yy + eps, det)
        opacity = np.float64(opacities[i])
        if settings.antialiased:
            # Yu et al. 2024, Mip-Splatting
            opacity *= math.sqrt(max(det0 / det, settings.compensation_min))
        x = tangents[0] * focal[0] + principal[0]
        y = tangents[1] * focal[1] + principal[1]
        log_opacity = log2(opacity)
        room = (log_opacity if settings.cull_extent else 0.0) - settings.log_alpha_min
        deviations = math.sqrt(max(room + EXPONENT_MARGIN, 0.0)) / WHITEN_TO_LOG2
        extent_x, extent_y = deviations * math.sqrt(xx + eps), deviations * math.sqrt(yy + eps)
        # Comparisons with NaN are false. `&` because `and` would be a branch.
        visible = (
            (z > settings.near)
            & (z < MAX_MAGNITUDE)
            & (opacity >= alpha_min)
            & (np.float64(opacities[i]) <= 1)
            & (a > 0)
            & (abs(x + y + b + c) < np.inf)
        )
        inside = (
            (x + extent_x >= edge)
            & (x - extent_x <= frame.width - edge)
            & (y + extent_y >= edge)
            & (y - extent_y <= frame.height - edge)
        )
        ellipses[CENTER_X + i], ellipses[CENTER_Y + i], ellipses[DEPTH + i] = x, y, z
        ellipses[WHITEN_A + i] = a * WHITEN_TO_LOG2
        ellipses[WHITEN_B + i] = b * WHITEN_TO_LOG2
        ellipses[WHITEN_C + i] = c * WHITEN_TO_LOG2
        ellipses[LOG_OPACITY + i] = log_opacity
        ellipses[EXTENT_X + i], ellipses[EXTENT_Y + i] = extent_x, extent_y
        status = VISIBLE if inside | (not settings.cull_frustum) else OUTSIDE_IMAGE
        ellipses[STATUS + i] = status if visible else CULLED


@inline
def _store_ellipse(ellipses, i, splats, bases, d):
    """Round an ellipse to splat d; the color is stored separately."""
    ellipse = Ellipse(
        x=ellipses[CENTER_X + i],
        y=ellipses[CENTER_Y + i],
        a=ellipses[WHITEN_A + i],
        b=ellipses[WHITEN_B + i],
        c=ellipses[WHITEN_C + i],
        extent_y=ellipses[EXTENT_Y + i],
    )
    store_ellipse(splats, bases, d, ellipse, ellipses[LOG_OPACITY + i], ellipses[DEPTH + i])


@inline
def _store_color(inputs, g, image, basis, splats, d):
    """Store the color of Gaussian g as the camera sees it; return whether its SH are usable."""
    sh = inputs.sh
    count = sh.shape[1]
    x = y = z = 0.0
    if count > 1:
        offset = plus(triple(inputs.means[g], 0), -1.0, triple(inputs.cameras[image], CENTER))
        length = math.sqrt(max(dot(offset, offset), MIN_SQUARED_DISTANCE))
        x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    write_sh_basis(x, y, z, count, basis)
    usable = True
    for channel in range(3):
        color = 0.5
        for k in range(count):
            coefficient = np.float64(sh[g, k, channel])
            usable &= abs(coefficient) < MAX_MAGNITUDE
            color += basis[k] * coefficient
        splats[d, RED + channel] = max(color, 0.0)
    return usable
