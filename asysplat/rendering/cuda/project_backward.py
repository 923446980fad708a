"""Compute gradients of Gaussians and cameras from those of their splats."""

import math

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas
from asysplat.rendering.cuda.math import (
    CAMERA,
    CAMERA_GRADIENT,
    CENTER,
    CX,
    CY,
    DOWN,
    FORWARD,
    FX,
    FY,
    MIN_SQUARED_DISTANCE,
    RIGHT,
    covariance,
    covariance_gradient,
    direction,
    dot,
    ellipse_rows,
    ellipse_rows_gradient,
    load3,
    load_camera,
    plus,
    project_mean,
    project_mean_gradient,
    scaled,
    sh_basis,
    sh_basis_gradient,
    store3,
    sum_sh,
    unit_quaternion,
    whitening,
)
from asysplat.rendering.cuda.splat import COLUMNS, GRADIENT

LOG_2 = tl.constexpr(math.log(2))
WHITEN_GRADIENT = tl.constexpr(math.log(2) * formulas.WHITEN_TO_LOG2)
# The determinants of covariances, in pixels^4, whose gradients fit float32; a Gaussian beyond, of
# less than 1e-7 or more than 1e7 pixels, does not change its shape.
MIN_DETERMINANT, MAX_DETERMINANT = tl.constexpr(1e-28), tl.constexpr(1e28)
PAIRS = tl.constexpr(8)  # pairs of a splat that are loaded at a time


@kernel
def sum_pairs(
    counts,
    first_pair,
    places,
    first_entry,
    grads,  # [pairs, CHANNELS] of the tiles from first_tile to end_tile, in the order of `entries`
    sums,  # [images * N, CHANNELS]
    num_splats,
    first_tile,
    end_tile,
    CHANNELS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Sum the gradients of each of BLOCK splats over tiles, in a fixed order.

    The sum of the tiles before is added to, and that of a splat in no tile is not written.
    """
    d = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(counts + d, mask=d < num_splats, other=0)
    first = tl.load(first_pair + d, mask=count > 0, other=0).to(tl.int64)
    start, end = tl.load(first_entry + first_tile), tl.load(first_entry + end_tile)
    column = tl.arange(0, COLUMNS)[None, :]
    row = sums + CHANNELS * d[:, None] + column
    drawn = (count > 0)[:, None] & (column < CHANNELS)
    total = tl.load(row, mask=drawn & (first_tile > 0), other=0.0)
    error = tl.zeros((BLOCK, COLUMNS), tl.float32)
    for step in range(0, tl.max(count, 0), PAIRS):
        for k in tl.static_range(PAIRS):  # loads of 8 pairs are on their way at a time
            pair = step + k
            place = tl.load(places + first + pair, mask=pair < count, other=-1).to(tl.int64)
            valid = ((place >= start) & (place < end))[:, None] & (column < CHANNELS)
            grad = grads + CHANNELS * (place - start)[:, None] + column
            value = tl.load(grad, mask=valid, other=0.0)
            # The rounding error of each sum (Knuth 1969, TwoSum).
            before = total
            total = before + value
            added = total - before
            error += (before - (total - added)) + (value - added)
    tl.store(row, total + error, mask=drawn)


@kernel
def project_backward(
    means,
    quats,
    scales,
    opacities,
    sh,
    cameras,
    counts,
    grads,  # from `sum_pairs`
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    grad_sh,  # zeros to add to, anything with ONE_VIEW; None without SH_NEEDED
    grad_cameras,  # [B * views, programs of a scene, 16] zeros; None without CAMERAS_NEEDED
    num,
    views,
    eps2d,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    HAS_DEPTH: tl.constexpr,
    SH_NEEDED: tl.constexpr,
    CAMERAS_NEEDED: tl.constexpr,
    ONE_VIEW: tl.constexpr,
    COUNT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the gradients of BLOCK Gaussians of a scene: the sum over its views, in order."""
    scene = tl.program_id(1).to(tl.int64)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = n < num
    g = scene * num + n
    zero = tl.zeros(n.shape, tl.float32)
    g_mean, g_scale, g_quat = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero, zero)
    g_opacity = zero
    for view in range(views):
        image = scene * views + view
        d = image * num + n
        drawn = tl.load(counts + d, mask=valid, other=0) > 0
        if tl.max(drawn.to(tl.int32), 0) > 0:
            camera = cameras + CAMERA * image
            opacity_part, mean_part, quat_part, scale_part = splat_backward(
                g,
                valid,
                drawn,
                inputs=(means, quats, scales, opacities, sh),
                camera=camera,
                splat_grads=load_splat_grads(grads, d, drawn, HAS_DEPTH),
                grad_sh=grad_sh,
                grad_cameras=grad_cameras,
                camera_offset=(image * tl.num_programs(0) + tl.program_id(0)) * CAMERA_GRADIENT,
                eps2d=eps2d,
                compensation_min=compensation_min,
                ANTIALIASED=ANTIALIASED,
                SH_NEEDED=SH_NEEDED,
                CAMERAS_NEEDED=CAMERAS_NEEDED,
                ONE_VIEW=ONE_VIEW,
                COUNT=COUNT,
            )
            g_opacity += tl.where(drawn, opacity_part, 0.0)
            g_mean = plus(g_mean, 1.0, keep_where(drawn, mean_part))
            g_scale = plus(g_scale, 1.0, keep_where(drawn, scale_part))
            g_quat = plus(g_quat, 1.0, keep_where(drawn, quat_part)) + (
                g_quat[3] + tl.where(drawn, quat_part[3], 0.0),
            )
        elif SH_NEEDED and ONE_VIEW:
            for k in tl.static_range(3 * COUNT):
                tl.store(grad_sh + 3 * COUNT * g + k, zero, mask=valid)
    store3(grad_means, g, g_mean, valid)
    store3(grad_scales, g, g_scale, valid)
    for k in tl.static_range(4):
        tl.store(grad_quats + 4 * g + k, g_quat[k], mask=valid)
    tl.store(grad_opacities + g, g_opacity, mask=valid)


@kernel
def load_splat_grads(grads, d, drawn, HAS_DEPTH: tl.constexpr):
    """Read the gradients of splats; that of the depth is 0 without one."""
    CHANNELS: tl.constexpr = GRADIENT if HAS_DEPTH else GRADIENT - 1
    row = grads + CHANNELS * d
    out = ()
    for k in tl.static_range(CHANNELS):
        out = out + (tl.load(row + k, mask=drawn, other=0.0),)
    if HAS_DEPTH:
        return out
    else:
        return out + (tl.zeros_like(out[0]),)


@kernel
def to_float32(values):
    """Round numbers to float32."""
    rounded = ()
    for k in tl.static_range(len(values)):
        rounded = rounded + (values[k].to(tl.float32),)
    return rounded


@kernel
def keep_where(condition, values):
    """Return three numbers where the condition holds, else zeros."""
    return (
        tl.where(condition, values[0], 0.0),
        tl.where(condition, values[1], 0.0),
        tl.where(condition, values[2], 0.0),
    )


@kernel
def store_sum(grad_cameras, camera_offset, values, drawn):
    """Store the sum of `values` where `drawn`."""
    tl.store(grad_cameras + camera_offset, tl.sum(tl.where(drawn, values, 0.0).to(tl.float64), 0))


@kernel
def store_sum3(grad_cameras, camera_offset, values, drawn):
    """Store three sums, see `store_sum`."""
    store_sum(grad_cameras, camera_offset, values[0], drawn)
    store_sum(grad_cameras, camera_offset + 1, values[1], drawn)
    store_sum(grad_cameras, camera_offset + 2, values[2], drawn)


@kernel
def splat_backward(
    g,
    valid,
    drawn,
    inputs,
    camera,
    splat_grads,
    grad_sh,
    grad_cameras,
    camera_offset,
    eps2d,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    SH_NEEDED: tl.constexpr,
    CAMERAS_NEEDED: tl.constexpr,
    ONE_VIEW: tl.constexpr,
    COUNT: tl.constexpr,
):
    """Compute the gradients of opacity, mean, quaternion and scale from the splats of one image.

    Only `drawn` splats count. Add to `grad_sh`, and write the camera's part at `camera_offset`.
    """
    means, quats, scales, opacities, sh = inputs
    g_x, g_y, g_a, g_b, g_c, g_log_opacity, g_red, g_green, g_blue, g_z = splat_grads
    # Repeat the forward pass. Differences cancel in it, so it is in float64. The gradients need not
    # be as exact, and most GPUs compute float64 at 1/64 of the rate of float32.
    mean, scale = load3(means, g, drawn), load3(scales, g, drawn)
    quat = unit_quaternion(quats, g, drawn)
    axes, center, focal, limits = load_camera(camera)
    offset, _, inverse_z, tangents, clamped, row_x, row_y = project_mean(
        mean, axes, center, focal, limits
    )
    mx, my, _, _ = ellipse_rows(quat, scale, row_x, row_y)
    _, xy, yy, _, det0, det = covariance(mx, my, eps2d)
    in_range = (det > MIN_DETERMINANT) & (det < MAX_DETERMINANT)
    quat, scale, offset = to_float32(quat), to_float32(scale), to_float32(offset)
    axes = (to_float32(axes[0]), to_float32(axes[1]), to_float32(axes[2]))
    focal, row_x, row_y = to_float32(focal), to_float32(row_x), to_float32(row_y)
    mx, my = to_float32(mx), to_float32(my)
    xy, var_y, det0, det = to_float32((xy, yy + eps2d, det0, det))
    projected = (offset, inverse_z.to(tl.float32), to_float32(tangents), to_float32(clamped))

    # Opacity, and antialiasing.
    g_opacity = g_log_opacity / tl.load(opacities + g, mask=drawn, other=1.0).to(tl.float32)
    g_det = tl.zeros_like(det)
    g_det0 = tl.zeros_like(det)
    if ANTIALIASED:
        # log compensation = (log det0 - log det) / 2
        half = tl.where(det0 > compensation_min * det, 0.5 * g_log_opacity, 0.0)
        g_det -= half / det
        g_det0 += tl.where(half == 0, 0.0, half / det0)

    # Whitening, covariance, scale and rotation.
    g_abc = (WHITEN_GRADIENT * g_a, WHITEN_GRADIENT * g_b, WHITEN_GRADIENT * g_c)
    abc = whitening(xy, var_y, det)
    g_mx, g_my = covariance_gradient(g_abc, g_det0, g_det, abc, mx, my, eps2d)
    g_mx, g_my = keep_where(in_range, g_mx), keep_where(in_range, g_my)
    g_scale, g_quat, g_row_x, g_row_y = ellipse_rows_gradient(g_mx, g_my, quat, scale, row_x, row_y)

    # The Jacobian's rows, and center and depth.
    g_offset, g_axes, g_focal, g_principal = project_mean_gradient(
        (LOG_2 * g_x, LOG_2 * g_y, g_z), (g_row_x, g_row_y), (row_x, row_y), projected, axes, focal
    )

    # Color.
    square, length, dx, dy, dz = direction(offset)
    basis = sh_basis(dx, dy, dz, COUNT)
    g_red = unclamped_gradient(sum_sh(sh, g, 0, basis, drawn, COUNT), g_red)
    g_green = unclamped_gradient(sum_sh(sh, g, 1, basis, drawn, COUNT), g_green)
    g_blue = unclamped_gradient(sum_sh(sh, g, 2, basis, drawn, COUNT), g_blue)
    if SH_NEEDED:
        for k in tl.static_range(COUNT):
            coefficients = grad_sh + 3 * (COUNT * g + k)
            accumulate(coefficients, basis[k] * g_red, valid, drawn, ONE_VIEW)
            accumulate(coefficients + 1, basis[k] * g_green, valid, drawn, ONE_VIEW)
            accumulate(coefficients + 2, basis[k] * g_blue, valid, drawn, ONE_VIEW)
    if COUNT > 1:
        g_basis = (tl.zeros_like(g_red),)
        for k in tl.static_range(1, COUNT):
            coefficients = sh + 3 * (COUNT * g + k)
            g_value = g_red * tl.load(coefficients, mask=drawn, other=0.0).to(tl.float32)
            g_value += g_green * tl.load(coefficients + 1, mask=drawn, other=0.0).to(tl.float32)
            g_value += g_blue * tl.load(coefficients + 2, mask=drawn, other=0.0).to(tl.float32)
            g_basis = g_basis + (g_value,)
        g_direction = sh_basis_gradient(dx, dy, dz, g_basis, COUNT)
        g_offset = plus(g_offset, 1 / length, g_direction)
        radial = dot(offset, g_direction) / (length * length * length)
        g_offset = plus(g_offset, tl.where(square > MIN_SQUARED_DISTANCE, -radial, 0.0), offset)

    if CAMERAS_NEEDED:
        store_sum3(grad_cameras, camera_offset + RIGHT, g_axes[0], drawn)
        store_sum3(grad_cameras, camera_offset + DOWN, g_axes[1], drawn)
        store_sum3(grad_cameras, camera_offset + FORWARD, g_axes[2], drawn)
        store_sum3(grad_cameras, camera_offset + CENTER, scaled(-1.0, g_offset), drawn)
        store_sum(grad_cameras, camera_offset + FX, g_focal[0], drawn)
        store_sum(grad_cameras, camera_offset + FY, g_focal[1], drawn)
        store_sum(grad_cameras, camera_offset + CX, g_principal[0], drawn)
        store_sum(grad_cameras, camera_offset + CY, g_principal[1], drawn)
    return g_opacity, g_offset, g_quat, g_scale


@kernel
def unclamped_gradient(color, grad):
    """Return the color's gradient, 0 where the color is clamped."""
    return tl.where(color > 0, grad, 0.0)


@kernel
def accumulate(pointers, values, valid, drawn, ONE_VIEW: tl.constexpr):
    """Add `values` where `drawn` to the numbers at `pointers`; of one view, write them."""
    if ONE_VIEW:
        tl.store(pointers, tl.where(drawn, values, 0.0), mask=valid)
    else:
        tl.store(pointers, tl.load(pointers, mask=drawn, other=0.0) + values, mask=drawn)
