"""Gaussians to splats, in float64 whatever the inputs: a splat is rounded once, at the end."""

import triton.language as tl

from asysplat.ops.triton_utils import kernel
from asysplat.rendering import formulas, interface
from asysplat.rendering.cuda.math import (
    CAMERA,
    CX,
    CY,
    FX,
    FY,
    covariance,
    direction,
    ellipse_rows,
    in_camera,
    load3,
    sh_basis,
    sum_sh,
    unit_quaternion,
    whitening,
)
from asysplat.rendering.cuda.splat import store_splat

MAX_MAGNITUDE = tl.constexpr(interface.MAX_MAGNITUDE)
WHITEN_TO_LOG2 = tl.constexpr(formulas.WHITEN_TO_LOG2)
EXPONENT_MARGIN = tl.constexpr(formulas.EXPONENT_MARGIN)
PIXEL_MARGIN = tl.constexpr(formulas.PIXEL_MARGIN)
COUNTERS = 2  # Gaussians that were culled by their opacity; those that were outside the image


@kernel
def project(
    means,
    quats,
    scales,
    opacities,
    sh,
    cameras,
    splats,
    depths,
    counters,
    num,
    views,
    height,
    width,
    alpha_min,
    log_alpha_min,
    eps2d,
    near,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    CULL_OPACITY: tl.constexpr,
    CULL_FRUSTUM: tl.constexpr,
    OWN_EXTENT: tl.constexpr,
    COUNT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Find the splats of BLOCK Gaussians in one image.

    Args:
        means, quats, scales, opacities, sh, cameras: see `Inputs`; COUNT coefficients of SH.
        splats: [images * num, 16], see `splat`; written where visible.
        depths: [images * num], 0 where culled; written.
        counters: [programs, COUNTERS]; written.
        num: Gaussians of a scene.
        views: of a scene.
        alpha_min, eps2d, near, compensation_min: see `Convention`; log_alpha_min is to base 2.
    """
    image = tl.program_id(1).to(tl.int64)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    g = image // views * num + n
    opacity = tl.load(opacities + g, mask=n < num, other=0.0).to(tl.float64)
    there = n < num
    if CULL_OPACITY:
        # Written so that NaN stays, and is culled below.
        there = there & ((opacity >= alpha_min) | (opacity != opacity))
    faint = tl.sum(((n < num) & (there == 0)).to(tl.int32), 0)
    mean, scale = load3(means, g, there), load3(scales, g, there)
    qw, qx, qy, qz, _ = unit_quaternion(quats, g, there)
    camera = cameras + CAMERA * image
    offset, tangent_x, tangent_y, z, _, _, _, row_x, row_y = in_camera(camera, mean)
    mx, my, _, _ = ellipse_rows((qw, qx, qy, qz), scale, row_x, row_y)
    xx, xy, yy, _, det0, det = covariance(mx, my, eps2d)
    a, b, c = whitening(xy, yy + eps2d, det)
    shown = (opacity <= 1) & there
    if ANTIALIASED:
        opacity *= tl.sqrt(tl.maximum(det0 / det, compensation_min))
    x = tangent_x * tl.load(camera + FX) + tl.load(camera + CX)
    y = tangent_y * tl.load(camera + FY) + tl.load(camera + CY)
    log_opacity = tl.log2(opacity)
    room = EXPONENT_MARGIN - log_alpha_min
    if OWN_EXTENT:
        room += log_opacity
    deviations = tl.sqrt(tl.maximum(room, 0.0)) / WHITEN_TO_LOG2
    extent_x, extent_y = deviations * tl.sqrt(xx + eps2d), deviations * tl.sqrt(yy + eps2d)
    # Every comparison with NaN is false.
    shown = shown & (z > near) & (z < MAX_MAGNITUDE) & (opacity >= alpha_min) & (a > 0)
    shown = shown & (tl.abs(x + y + b + c) < float("inf"))
    edge = 0.5 - PIXEL_MARGIN
    inside = (x + extent_x >= edge) & (x - extent_x <= width - edge)
    inside = inside & (y + extent_y >= edge) & (y - extent_y <= height - edge)
    outside = 0
    if CULL_FRUSTUM:
        outside += tl.sum((shown & (inside == 0)).to(tl.int32), 0)
        shown = shown & inside
    d = image * num + n
    if tl.max(shown.to(tl.int32), 0) > 0:
        color, shown = colors(sh, g, offset, shown, COUNT)
        a, b, c = a * WHITEN_TO_LOG2, b * WHITEN_TO_LOG2, c * WHITEN_TO_LOG2
        ellipse = (x, y, a, b, c, extent_y * (1 + 1e-6))
        store_splat(splats, d, ellipse, log_opacity, color, z, shown)
    tl.store(depths + d, tl.where(shown, z, 0.0).to(tl.float32), mask=n < num)
    counter = counters + 2 * (image * tl.num_programs(0) + tl.program_id(0))
    tl.store(counter, faint)
    tl.store(counter + 1, outside)


@kernel
def colors(sh, g, offset, shown, COUNT: tl.constexpr):
    """Return the three channels seen along `offset`, and which of `shown` have a usable SH."""
    _, _, x, y, z = direction(offset)
    functions = sh_basis(x, y, z, COUNT)
    red = tl.maximum(sum_sh(sh, g, 0, functions, shown, COUNT), 0.0)
    green = tl.maximum(sum_sh(sh, g, 1, functions, shown, COUNT), 0.0)
    blue = tl.maximum(sum_sh(sh, g, 2, functions, shown, COUNT), 0.0)
    for k in tl.static_range(3 * COUNT):
        coefficient = tl.load(sh + 3 * COUNT * g + k, mask=shown, other=0.0)
        shown = shown & (tl.abs(coefficient) < MAX_MAGNITUDE)
    return (red, green, blue), shown
