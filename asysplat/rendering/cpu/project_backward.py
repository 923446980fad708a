"""Gradients of the Gaussians and the cameras from those of their splats, in float64."""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.rendering import camera_rows as cam
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.geometry import (
    clamp,
    covariance,
    ellipse_rows,
    jacobian_row,
    whitening,
)
from asysplat.rendering.cpu.project import TINY
from asysplat.rendering.cpu.sh import basis, basis_gradient
from asysplat.rendering.cpu.vectors import (
    cross,
    dot,
    plus,
    rotation_columns,
    rotation_gradient,
    row3,
    scaled,
    times,
    unit_quaternion,
)
from asysplat.rendering.formulas import WHITEN_TO_LOG2

LOG_2 = math.log(2)


@kernel
def project_backward(
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
    convention,
    antialiased,
    needs,
    first_pair,
    grads,
    grad_means,
    grad_quats,
    grad_scales,
    grad_opacities,
    grad_sh,
    grad_cameras,
):
    """Gradients of blocks start to stop of the scenes' Gaussians.

    Args:
        needs: whether the harmonics' and the cameras' gradients are asked for.
        first_pair: [images * N + 1].
        grads: [pairs, 10].
        grad_means, grad_quats, grad_scales, grad_opacities, grad_sh: [B * N, ...], float32 or
            float64, every element written.
        grad_cameras: [B * V, blocks, 16] float64, each block's part.
        quats, scales: flat. Others: as for `project`.
    """
    blocks = grad_cameras.shape[1]
    num = means.shape[0] * views // cameras.shape[0]
    count = sh.shape[1]
    functions, g_functions, pixel = np.empty(16), np.zeros(16), np.empty(col.GRADIENT)
    g_mean, g_quat, g_scale = np.empty(3), np.empty(4), np.empty(3)
    g_sh = np.empty((count, 3))
    sh_needed, _ = needs
    for index in range(start, stop):
        scene, block = index // blocks, index % blocks
        for view in range(views):
            grad_cameras[scene * views + view, block] = 0
        for n in range(block * block_size, min((block + 1) * block_size, num)):
            g = scene * num + n
            _clear(g_mean)
            _clear(g_quat)
            _clear(g_scale)
            if sh_needed:
                for k in range(count):
                    _clear(g_sh[k])
            g_opacity = 0.0
            for view in range(views):
                image = scene * views + view
                d = image * num + n
                if first_pair[d] == first_pair[d + 1]:
                    continue
                _clear(pixel)
                for pair in range(first_pair[d], first_pair[d + 1]):
                    for k in range(col.GRADIENT):
                        pixel[k] += grads[pair, k]
                g_opacity += _splat_backward(
                    g, means, quats, scales, opacities, sh, cameras, image, convention,
                    antialiased, needs, functions, g_functions, pixel, g_mean, g_quat, g_scale,
                    g_sh, grad_cameras[image, block],
                )  # fmt: skip
            grad_opacities[g] = g_opacity
            for k in range(3):
                grad_means[g, k], grad_scales[g, k] = g_mean[k], g_scale[k]
            for k in range(4):
                grad_quats[g, k] = g_quat[k]
            if sh_needed:
                for k in range(count):
                    for channel in range(3):
                        grad_sh[g, k, channel] = g_sh[k, channel]


@inline
def _clear(vector):
    for k in range(len(vector)):
        vector[k] = 0.0


@inline
def _add3(out, start, factor, values):
    out[start] += factor * values[0]
    out[start + 1] += factor * values[1]
    out[start + 2] += factor * values[2]


@inline
def _splat_backward(
    g, means, quats, scales, opacities, sh, cameras, image, convention, antialiased,
    needs, functions, g_functions, pixel, g_mean, g_quat, g_scale, g_sh, g_camera,
):  # fmt: skip
    """Add one splat's part to the gradients; returns that of the opacity."""
    _, _, eps, _, compensation_min = convention
    sh_needed, cameras_needed = needs
    right, down = row3(cameras, image, cam.RIGHT), row3(cameras, image, cam.DOWN)
    forward = row3(cameras, image, cam.FORWARD)
    fx, fy = cameras[image, cam.FX], cameras[image, cam.FY]

    # What `project` computed.
    offset = plus(row3(means, g), -1.0, row3(cameras, image, cam.CENTER))
    z = dot(forward, offset)
    inverse_z = 1 / z
    tangent_x, tangent_y = dot(right, offset) * inverse_z, dot(down, offset) * inverse_z
    inside_x = clamp(tangent_x, cameras[image, cam.LOW_X], cameras[image, cam.HIGH_X])
    inside_y = clamp(tangent_y, cameras[image, cam.LOW_Y], cameras[image, cam.HIGH_Y])
    row_x = jacobian_row(right, forward, fx, inverse_z, inside_x)
    row_y = jacobian_row(down, forward, fy, inverse_z, inside_y)
    mx, my, turned_x, turned_y, scale = ellipse_rows(quats, scales, g, row_x, row_y)
    _, xy, yy, minors, det0, det = covariance(mx, my, eps)
    var_y = yy + eps
    a, b, c = whitening(xy, var_y, det)

    # Opacity, and antialiasing.
    opacity = float(opacities[g])
    g_det0 = g_det = 0.0
    g_opacity = pixel[col.G_LOG_OPACITY] / opacity
    if antialiased and det0 > compensation_min * det:
        half = 0.5 * pixel[col.G_LOG_OPACITY]  # log compensation = (log det0 - log det) / 2
        g_det0, g_det = half / det0, -half / det

    # Whitening to rows of M.
    factor = LOG_2 * WHITEN_TO_LOG2
    g_a, g_b, g_c = (
        factor * pixel[col.G_A],
        factor * pixel[col.G_B],
        factor * pixel[col.G_C],
    )
    g_var_y = (g_a * a - g_b * b - g_c * c) / (2 * var_y)
    g_xy = -g_b * a / var_y
    g_det -= (g_a * a + g_b * b) / (2 * det)
    g_minors = g_det0 + g_det
    g_xx, g_yy = eps * g_det, g_var_y + eps * g_det
    g_mx = plus(plus(scaled(2 * g_xx, mx), g_xy, my), 2 * g_minors, cross(my, minors))
    g_my = plus(plus(scaled(2 * g_yy, my), g_xy, mx), 2 * g_minors, cross(minors, mx))

    # Rows of M to scale, rotation and the Jacobian's rows.
    _add3(g_scale, 0, 1.0, plus(times(g_mx, turned_x), 1.0, times(g_my, turned_y)))
    h_x, h_y = times(g_mx, scale), times(g_my, scale)
    qw, qx, qy, qz, inverse = unit_quaternion(quats, 4 * g)
    axis0, axis1, axis2 = rotation_columns(qw, qx, qy, qz)
    turn = rotation_gradient(
        qw, qx, qy, qz, inverse,
        plus(scaled(h_x[0], row_x), h_y[0], row_y),
        plus(scaled(h_x[1], row_x), h_y[1], row_y),
        plus(scaled(h_x[2], row_x), h_y[2], row_y),
    )  # fmt: skip
    for k in range(4):
        g_quat[k] += turn[k]
    g_row_x = plus(plus(scaled(h_x[0], axis0), h_x[1], axis1), h_x[2], axis2)
    g_row_y = plus(plus(scaled(h_y[0], axis0), h_y[1], axis1), h_y[2], axis2)

    # The Jacobian's rows and the centre to the camera and the mean.
    g_x, g_y = LOG_2 * pixel[col.G_X], LOG_2 * pixel[col.G_Y]
    g_z = pixel[col.G_DEPTH]
    g_z -= inverse_z * (dot(row_x, g_row_x) + dot(row_y, g_row_y))
    g_fx = g_x * tangent_x + dot(row_x, g_row_x) / fx
    g_fy = g_y * tangent_y + dot(row_y, g_row_y) / fy
    g_cx, g_cy = g_x, g_y
    g_inside_x = -fx * inverse_z * dot(forward, g_row_x)
    g_inside_y = -fy * inverse_z * dot(forward, g_row_y)
    g_tangent_x, g_tangent_y = g_x * fx, g_y * fy
    if inside_x == tangent_x:
        g_tangent_x += g_inside_x
    else:  # the limit is (constant - cx) / fx
        g_cx -= g_inside_x / fx
        g_fx -= g_inside_x * inside_x / fx
    if inside_y == tangent_y:
        g_tangent_y += g_inside_y
    else:
        g_cy -= g_inside_y / fy
        g_fy -= g_inside_y * inside_y / fy
    g_z -= inverse_z * (g_tangent_x * tangent_x + g_tangent_y * tangent_y)
    g_u, g_v = g_tangent_x * inverse_z, g_tangent_y * inverse_z
    g_offset = plus(plus(scaled(g_u, right), g_v, down), g_z, forward)

    # Colour.
    square = dot(offset, offset)
    length = math.sqrt(max(square, TINY))
    direction = scaled(1 / length, offset)
    count = sh.shape[1]
    basis(direction[0], direction[1], direction[2], count, functions)
    _clear(g_functions)
    for channel in range(3):
        color = 0.5
        for k in range(count):
            color += functions[k] * float(sh[g, k, channel])
        if color > 0:
            g_color = pixel[col.G_RED + channel]
            for k in range(count):
                if sh_needed:
                    g_sh[k, channel] += functions[k] * g_color
                g_functions[k] += float(sh[g, k, channel]) * g_color
    g_direction = basis_gradient(direction[0], direction[1], direction[2], count, g_functions)
    g_offset = plus(g_offset, 1 / length, g_direction)
    if square > TINY:
        g_offset = plus(g_offset, -dot(direction, g_direction) / length, direction)

    _add3(g_mean, 0, 1.0, g_offset)
    if cameras_needed:
        _add3(g_camera, cam.RIGHT, 1.0, plus(scaled(g_u, offset), fx * inverse_z, g_row_x))
        _add3(g_camera, cam.DOWN, 1.0, plus(scaled(g_v, offset), fy * inverse_z, g_row_y))
        through_x = plus(scaled(g_z, offset), -fx * inverse_z * inside_x, g_row_x)
        _add3(g_camera, cam.FORWARD, 1.0, plus(through_x, -fy * inverse_z * inside_y, g_row_y))
        _add3(g_camera, cam.CENTER, -1.0, g_offset)
        g_camera[cam.FX] += g_fx
        g_camera[cam.FY] += g_fy
        g_camera[cam.CX] += g_cx
        g_camera[cam.CY] += g_cy
    return g_opacity
