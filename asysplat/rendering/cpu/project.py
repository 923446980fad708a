"""Gaussians to splats, in float64 whatever the inputs: a splat is rounded once, at the end."""

import math

import numpy as np

from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.geometry import (
    clamp,
    compensation,
    covariance,
    ellipse_rows,
    jacobian_row,
    whitening,
)
from asysplat.rendering.cpu.kernel import inline, kernel
from asysplat.rendering.cpu.sh import basis
from asysplat.rendering.cpu.tiles import count_tiles
from asysplat.rendering.cpu.vectors import dot, plus, row3

LARGEST = float(np.finfo(np.float32).max)
TINY = 1e-20  # below the square of any distance that matters


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
    first_tiles,
    boxes,
    histograms,
):
    """Splats of blocks start to stop, and how many tiles they touch.

    Args:
        means, quats, scales, opacities, sh: [B * N, ...].
        cameras: [B * V, 20] float64, views: V.
        block_size: Gaussians of a block.
        size: height and width in pixels, columns in tiles.
        convention: alpha_min, log2(alpha_min), eps2d, near, compensation_min.
        skips: whether to use the opacity cull, the opacity's extent, the exact ellipse.
        splats: [B * V * N, 16], written where visible.
        counts, first_tiles: [B * V * N] pairs of each, 0 where culled, and its first tile.
        boxes: [B * V, blocks] pairs there would be with boxes in the place of ellipses.
        histograms: [B * V, blocks, tiles] pairs of each tile.
    """
    alpha_min = convention[0]
    skip_opacity, _, exact = skips
    bases = splats.view(np.int32)
    blocks = histograms.shape[1]
    images = cameras.shape[0]
    num = splats.shape[0] // images
    functions = np.empty(16)
    for index in range(start, stop):
        image, block = index // blocks, index % blocks
        histogram = histograms[image, block]
        histogram[:] = 0
        boxes[image, block] = 0
        for n in range(block * block_size, min((block + 1) * block_size, num)):
            g, d = image // views * num + n, image * num + n
            counts[d] = 0
            if skip_opacity and not opacities[g] >= alpha_min:
                continue
            if splat(
                g,
                d,
                means,
                quats,
                scales,
                opacities,
                sh,
                cameras,
                image,
                size,
                convention,
                antialiased,
                skips,
                functions,
                splats,
                bases,
            ):
                counts[d], first_tiles[d], box = count_tiles(
                    splats, bases, d, size, exact, histogram
                )
                boxes[image, block] += box


@inline
def splat(
    g, d, means, quats, scales, opacities, sh, cameras, image, size, convention, antialiased, skips,
    functions, splats, bases,
):  # fmt: skip
    """Write splat d of Gaussian g in an image; whether it can be seen."""
    alpha_min, log_alpha_min, eps, near, compensation_min = convention
    _, own_extent, _ = skips
    height, width, _ = size
    right, down = row3(cameras, image, col.RIGHT), row3(cameras, image, col.DOWN)
    forward = row3(cameras, image, col.FORWARD)
    fx, fy = cameras[image, col.FX], cameras[image, col.FY]
    cx, cy = cameras[image, col.CX], cameras[image, col.CY]
    # Relative to the camera first: exact for scenes far from the origin.
    offset = plus(row3(means, g), -1.0, row3(cameras, image, col.CENTER))
    z = dot(forward, offset)
    if not near < z < LARGEST:  # written so that NaN is culled
        return False
    inverse_z = 1 / z
    tangent_x, tangent_y = dot(right, offset) * inverse_z, dot(down, offset) * inverse_z
    inside_x = clamp(tangent_x, cameras[image, col.LOW_X], cameras[image, col.HIGH_X])
    inside_y = clamp(tangent_y, cameras[image, col.LOW_Y], cameras[image, col.HIGH_Y])
    row_x = jacobian_row(right, forward, fx, inverse_z, inside_x)
    row_y = jacobian_row(down, forward, fy, inverse_z, inside_y)
    mx, my, _, _, _ = ellipse_rows(quats, scales, g, row_x, row_y)
    xx, xy, yy, _, det0, det = covariance(mx, my, eps)
    a, b, c = whitening(xy, yy + eps, det)
    opacity = float(opacities[g])
    if antialiased:
        opacity *= compensation(det0, det, compensation_min)
    x, y = tangent_x * fx + cx, tangent_y * fy + cy
    # NaN and infinity anywhere make this sum neither larger nor smaller than 0.
    if not (opacity >= alpha_min and a > 0 and abs(x + y + b + c + opacity) < np.inf):
        return False
    log_opacity = math.log2(opacity)
    room = (log_opacity if own_extent else 0.0) - log_alpha_min + col.EXPONENT_MARGIN
    reach = math.sqrt(room) / col.WHITEN_TO_LOG2
    reach_x, reach_y = reach * math.sqrt(xx + eps), reach * math.sqrt(yy + eps)
    edge = 0.5 - col.PIXEL_MARGIN
    if not (
        x + reach_x >= edge
        and x - reach_x <= width - edge
        and y + reach_y >= edge
        and y - reach_y <= height - edge
    ):
        return False
    if not write_color(g, d, offset, sh, functions, splats):
        return False
    base_x = min(max(math.floor(x), -col.FARTHEST), col.FARTHEST)
    base_y = min(max(math.floor(y), -col.FARTHEST), col.FARTHEST)
    bases[d, col.BASE_X], bases[d, col.BASE_Y] = int(base_x), int(base_y)
    splats[d, col.X], splats[d, col.Y] = x - base_x, y - base_y
    a, b = a * col.WHITEN_TO_LOG2, b * col.WHITEN_TO_LOG2
    splats[d, col.A], splats[d, col.B] = a, b
    splats[d, col.A_REST] = a - float(splats[d, col.A])
    splats[d, col.B_REST] = b - float(splats[d, col.B])
    splats[d, col.C] = c * col.WHITEN_TO_LOG2
    splats[d, col.LOG_OPACITY] = log_opacity
    splats[d, col.DEPTH] = z
    splats[d, col.DEPTH_REST] = z - float(splats[d, col.DEPTH])
    splats[d, col.REACH_Y] = reach_y * (1 + 1e-6)
    return True


@inline
def write_color(g, d, offset, sh, functions, splats):
    """The colour seen along `offset`; False, and the splat is culled, where it is not finite."""
    count = sh.shape[1]
    x = y = z = 0.0
    if count > 1:
        length = math.sqrt(max(dot(offset, offset), TINY))
        x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    basis(x, y, z, count, functions)
    for channel in range(3):
        color = 0.5
        for k in range(count):
            color += functions[k] * float(sh[g, k, channel])
        splats[d, col.RED + channel] = max(color, 0.0)
        if not abs(color) < LARGEST:
            return False
    return True
