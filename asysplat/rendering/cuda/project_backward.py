"""Gradients of the Gaussians and the cameras from those of their splats, in float64."""

import math

import triton.language as tl

from asysplat.ops.triton_utils import kernel
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
    cross,
    direction,
    dot,
    ellipse_rows,
    in_camera,
    load1,
    load3,
    load_row3,
    plus,
    rotation_columns,
    rotation_gradient,
    scaled,
    sh_basis,
    sh_basis_gradient,
    store3,
    sum_sh,
    times,
    unit_quaternion,
    whitening,
)
from asysplat.rendering.cuda.splat import GRADIENT

LOG_2 = tl.constexpr(math.log(2))
WHITEN_GRADIENT = tl.constexpr(math.log(2) * formulas.WHITEN_TO_LOG2)
PAIRS = tl.constexpr(8)  # of a splat that are summed at a time


@kernel
def sum_pairs(counts, first_pair, grads, num_splats, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """Sum the gradients of each of BLOCK splats over its tiles, in a fixed order.

    The sum is left in the place of the splat's first pair.

    Args:
        counts, first_pair: [num_splats].
        grads: [pairs, 10], of which the first CHANNELS are summed.
    """
    d = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(counts + d, mask=d < num_splats, other=0)
    several = count > 1
    most = tl.max(tl.where(several, count, 0), 0)
    if most > 0:
        row = grads + GRADIENT * tl.load(first_pair + d, mask=several, other=0).to(tl.int64)
        step = tl.arange(0, PAIRS)
        for channel in tl.static_range(CHANNELS):
            total = tl.zeros((BLOCK,), tl.float64)
            for start in range(0, most, PAIRS):
                pair = start + step[None, :]
                here = several[:, None] & (pair < count[:, None])
                values = tl.load(row[:, None] + GRADIENT * pair + channel, mask=here, other=0.0)
                total += tl.sum(values.to(tl.float64), 1)
            tl.store(row + channel, total.to(tl.float32), mask=several)


@kernel
def project_backward(
    means,
    quats,
    scales,
    opacities,
    sh,
    cameras,
    counts,
    first_pair,
    grads,
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    grad_sh,
    grad_cameras,
    num,
    views,
    eps2d,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    HAS_DEPTH: tl.constexpr,
    SH_NEEDED: tl.constexpr,
    CAMERAS_NEEDED: tl.constexpr,
    COUNT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the gradients of BLOCK Gaussians of a scene: the sum over its views, in order.

    Args:
        counts, first_pair: [images * num], see `Lists`.
        grads: [pairs, 10], see `splat` and `sum_pairs`; the last column is read only with
            HAS_DEPTH.
        grad_means, grad_quats, grad_scales, grad_opacities: [B * num, ...], every element written.
        grad_sh: [B * num, COUNT, 3], zeros to add to; None without SH_NEEDED.
        grad_cameras: [B * views, programs of a scene, 16] float64, zeros where each program writes
            its part; None without CAMERAS_NEEDED.
        Others: as for `project`.
    """
    scene = tl.program_id(1).to(tl.int64)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = n < num
    g = scene * num + n
    zero = tl.zeros(n.shape, tl.float64)
    g_mean, g_scale, g_quat = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero, zero)
    g_opacity = zero
    for view in range(views):
        image = scene * views + view
        d = image * num + n
        drawn = tl.load(counts + d, mask=there, other=0) > 0
        if tl.max(drawn.to(tl.int32), 0) > 0:
            camera = cameras + CAMERA * image
            first = tl.load(first_pair + d, mask=drawn, other=0).to(tl.int64)
            opacity_part, mean_part, quat_part, scale_part = splat_backward(
                g,
                drawn,
                inputs=(means, quats, scales, opacities, sh),
                camera=camera,
                splat_grads=load_splat_grads(grads, first, drawn, HAS_DEPTH),
                grad_sh=grad_sh,
                grad_cameras=grad_cameras,
                place=(image * tl.num_programs(0) + tl.program_id(0)) * CAMERA_GRADIENT,
                eps2d=eps2d,
                compensation_min=compensation_min,
                ANTIALIASED=ANTIALIASED,
                SH_NEEDED=SH_NEEDED,
                CAMERAS_NEEDED=CAMERAS_NEEDED,
                COUNT=COUNT,
            )
            g_opacity += tl.where(drawn, opacity_part, 0.0)
            g_mean = add_where(g_mean, drawn, mean_part)
            g_scale = add_where(g_scale, drawn, scale_part)
            g_quat = (
                g_quat[0] + tl.where(drawn, quat_part[0], 0.0),
                g_quat[1] + tl.where(drawn, quat_part[1], 0.0),
                g_quat[2] + tl.where(drawn, quat_part[2], 0.0),
                g_quat[3] + tl.where(drawn, quat_part[3], 0.0),
            )
    store3(grad_means, g, g_mean, there)
    store3(grad_scales, g, g_scale, there)
    for k in tl.static_range(4):
        tl.store(grad_quats + 4 * g + k, g_quat[k], mask=there)
    tl.store(grad_opacities + g, g_opacity, mask=there)


@kernel
def load_splat_grads(grads, first, drawn, HAS_DEPTH: tl.constexpr):
    """Read the gradients of splats from those of their first pairs, see `sum_pairs`."""
    row = grads + GRADIENT * first
    out = (load1(row, 0, drawn), load1(row, 1, drawn), load1(row, 2, drawn), load1(row, 3, drawn))
    out = out + (load1(row, 4, drawn), load1(row, 5, drawn), load1(row, 6, drawn))
    out = out + (load1(row, 7, drawn), load1(row, 8, drawn))
    if HAS_DEPTH:
        return out + (load1(row, 9, drawn),)
    else:
        return out + (tl.zeros_like(out[0]),)


@kernel
def add_where(total, drawn, part):
    """Add the three numbers of `part` where `drawn`."""
    return (
        total[0] + tl.where(drawn, part[0], 0.0),
        total[1] + tl.where(drawn, part[1], 0.0),
        total[2] + tl.where(drawn, part[2], 0.0),
    )


@kernel
def store_sum(grad_cameras, place, values, drawn):
    """Store the sum of `values` where `drawn`."""
    tl.store(grad_cameras + place, tl.sum(tl.where(drawn, values, 0.0), 0))


@kernel
def store_sum3(grad_cameras, place, values, drawn):
    """Store three sums, see `store_sum`."""
    store_sum(grad_cameras, place, values[0], drawn)
    store_sum(grad_cameras, place + 1, values[1], drawn)
    store_sum(grad_cameras, place + 2, values[2], drawn)


@kernel
def splat_backward(
    g,
    drawn,
    inputs,
    camera,
    splat_grads,
    grad_sh,
    grad_cameras,
    place,
    eps2d,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    SH_NEEDED: tl.constexpr,
    CAMERAS_NEEDED: tl.constexpr,
    COUNT: tl.constexpr,
):
    """Return the gradients of opacity, mean, quaternion and scale from splats of one image.

    Only those that are `drawn` count. Adds to `grad_sh`, and writes the camera's part to its
    `place`.
    """
    means, quats, scales, opacities, sh = inputs
    g_x, g_y, g_a, g_b, g_c, g_log_opacity, g_red, g_green, g_blue, g_z = splat_grads
    # What `project` computed.
    mean, scale = load3(means, g, drawn), load3(scales, g, drawn)
    qw, qx, qy, qz, inverse = unit_quaternion(quats, g, drawn)
    right, down = load_row3(camera, RIGHT), load_row3(camera, DOWN)
    forward = load_row3(camera, FORWARD)
    fx, fy = tl.load(camera + FX), tl.load(camera + FY)
    offset, tangent_x, tangent_y, _, inverse_z, inside_x, inside_y, row_x, row_y = in_camera(
        camera, mean
    )
    mx, my, turned_x, turned_y = ellipse_rows((qw, qx, qy, qz), scale, row_x, row_y)
    _, xy, yy, minors, det0, det = covariance(mx, my, eps2d)
    var_y = yy + eps2d
    a, b, c = whitening(xy, var_y, det)

    # Opacity, and antialiasing.
    g_opacity = g_log_opacity / load1(opacities, g, drawn)
    g_det = tl.zeros_like(det)
    g_minors = tl.zeros_like(det)
    if ANTIALIASED:
        # log compensation = (log det0 - log det) / 2
        half = tl.where(det0 > compensation_min * det, 0.5 * g_log_opacity, 0.0)
        g_det -= half / det
        g_minors += tl.where(half == 0, 0.0, half / det0)

    # Whitening to rows of M.
    g_a, g_b, g_c = WHITEN_GRADIENT * g_a, WHITEN_GRADIENT * g_b, WHITEN_GRADIENT * g_c
    g_var_y = (g_a * a - g_b * b - g_c * c) / (2 * var_y)
    g_xy = -g_b * a / var_y
    g_det -= (g_a * a + g_b * b) / (2 * det)
    g_minors += g_det
    g_xx, g_yy = eps2d * g_det, g_var_y + eps2d * g_det
    g_mx = plus(plus(scaled(2 * g_xx, mx), g_xy, my), 2 * g_minors, cross(my, minors))
    g_my = plus(plus(scaled(2 * g_yy, my), g_xy, mx), 2 * g_minors, cross(minors, mx))

    # Rows of M to scale, rotation and the Jacobian's rows.
    g_scale = plus(times(g_mx, turned_x), 1.0, times(g_my, turned_y))
    h_x, h_y = times(g_mx, scale), times(g_my, scale)
    g_quat = rotation_gradient(
        qw, qx, qy, qz, inverse,
        plus(scaled(h_x[0], row_x), h_y[0], row_y),
        plus(scaled(h_x[1], row_x), h_y[1], row_y),
        plus(scaled(h_x[2], row_x), h_y[2], row_y),
    )  # fmt: skip
    axis0, axis1, axis2 = rotation_columns(qw, qx, qy, qz)
    g_row_x = plus(plus(scaled(h_x[0], axis0), h_x[1], axis1), h_x[2], axis2)
    g_row_y = plus(plus(scaled(h_y[0], axis0), h_y[1], axis1), h_y[2], axis2)

    # The Jacobian's rows and the center to the camera and the mean.
    g_x, g_y = LOG_2 * g_x, LOG_2 * g_y
    g_z -= inverse_z * (dot(row_x, g_row_x) + dot(row_y, g_row_y))
    g_fx = g_x * tangent_x + dot(row_x, g_row_x) / fx
    g_fy = g_y * tangent_y + dot(row_y, g_row_y) / fy
    g_inside_x = -fx * inverse_z * dot(forward, g_row_x)
    g_inside_y = -fy * inverse_z * dot(forward, g_row_y)
    # Where it is taken at the limit, that is (constant - cx) / fx.
    free_x, free_y = inside_x == tangent_x, inside_y == tangent_y
    g_tangent_x = g_x * fx + tl.where(free_x, g_inside_x, 0.0)
    g_tangent_y = g_y * fy + tl.where(free_y, g_inside_y, 0.0)
    g_limit_x = tl.where(free_x, 0.0, g_inside_x / fx)
    g_limit_y = tl.where(free_y, 0.0, g_inside_y / fy)
    g_z -= inverse_z * (g_tangent_x * tangent_x + g_tangent_y * tangent_y)
    g_u, g_v = g_tangent_x * inverse_z, g_tangent_y * inverse_z
    g_offset = plus(plus(scaled(g_u, right), g_v, down), g_z, forward)

    # Color.
    square, length, dx, dy, dz = direction(offset)
    functions = sh_basis(dx, dy, dz, COUNT)
    g_red = where_lit(sum_sh(sh, g, 0, functions, drawn, COUNT), g_red)
    g_green = where_lit(sum_sh(sh, g, 1, functions, drawn, COUNT), g_green)
    g_blue = where_lit(sum_sh(sh, g, 2, functions, drawn, COUNT), g_blue)
    if SH_NEEDED:
        for k in tl.static_range(COUNT):
            coefficients = grad_sh + 3 * (COUNT * g + k)
            add_to(coefficients, functions[k] * g_red, drawn)
            add_to(coefficients + 1, functions[k] * g_green, drawn)
            add_to(coefficients + 2, functions[k] * g_blue, drawn)
    if COUNT > 1:
        g_functions = (tl.zeros_like(g_red),)
        for k in tl.static_range(1, COUNT):
            coefficients = sh + 3 * (COUNT * g + k)
            g_function = g_red * tl.load(coefficients, mask=drawn, other=0.0).to(tl.float32)
            g_function += g_green * tl.load(coefficients + 1, mask=drawn, other=0.0).to(tl.float32)
            g_function += g_blue * tl.load(coefficients + 2, mask=drawn, other=0.0).to(tl.float32)
            g_functions = g_functions + (g_function,)
        g_dx, g_dy, g_dz = sh_basis_gradient(dx, dy, dz, g_functions, COUNT)
        g_direction = (g_dx.to(tl.float64), g_dy.to(tl.float64), g_dz.to(tl.float64))
        g_offset = plus(g_offset, 1 / length, g_direction)
        radial = dot(offset, g_direction) / (length * length * length)
        g_offset = plus(g_offset, tl.where(square > MIN_SQUARED_DISTANCE, -radial, 0.0), offset)

    if CAMERAS_NEEDED:
        right_part = plus(scaled(g_u, offset), fx * inverse_z, g_row_x)
        down_part = plus(scaled(g_v, offset), fy * inverse_z, g_row_y)
        forward_part = plus(scaled(g_z, offset), -fx * inverse_z * inside_x, g_row_x)
        forward_part = plus(forward_part, -fy * inverse_z * inside_y, g_row_y)
        store_sum3(grad_cameras, place + RIGHT, right_part, drawn)
        store_sum3(grad_cameras, place + DOWN, down_part, drawn)
        store_sum3(grad_cameras, place + FORWARD, forward_part, drawn)
        store_sum3(grad_cameras, place + CENTER, scaled(-1.0, g_offset), drawn)
        store_sum(grad_cameras, place + FX, g_fx - g_limit_x * inside_x, drawn)
        store_sum(grad_cameras, place + FY, g_fy - g_limit_y * inside_y, drawn)
        store_sum(grad_cameras, place + CX, g_x - g_limit_x, drawn)
        store_sum(grad_cameras, place + CY, g_y - g_limit_y, drawn)
    return g_opacity, g_offset, g_quat, g_scale


@kernel
def where_lit(color, grad):
    """Return the color's gradient in float32, 0 where the color is clamped."""
    return tl.where(color > 0, grad.to(tl.float32), 0.0)


@kernel
def add_to(place, values, there):
    """Add `values` to what stands at `place`."""
    tl.store(place, tl.load(place, mask=there, other=0.0) + values, mask=there)
