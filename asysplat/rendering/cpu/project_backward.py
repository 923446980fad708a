"""Gradients of the Gaussians and the cameras from those of their splats, in float64."""

import math
from typing import NamedTuple

import numpy as np

from asysplat.ops.simd.kernel import inline, kernel
from asysplat.rendering.cpu.math import (
    covariance,
    cross,
    dot,
    ellipse_rows,
    in_camera,
    load_camera,
    plus,
    rotation_columns,
    rotation_gradient,
    row3,
    scaled,
    sh_basis_gradient,
    times,
    unit_quaternion,
    whitening,
    write_sh_basis,
)
from asysplat.rendering.cpu.splat import (
    G_A,
    G_B,
    G_C,
    G_DEPTH,
    G_LOG_OPACITY,
    G_RED,
    G_X,
    G_Y,
    GRADIENT,
)
from asysplat.rendering.formulas import CENTER, CX, CY, DOWN, FORWARD, FX, FY, RIGHT, WHITEN_TO_LOG2
from asysplat.rendering.interface import MIN_SQUARED_DISTANCE

LOG_2 = math.log(2)
# Where the gradients of a Gaussian's mean, quaternion, scale and SH begin among its sums.
MEAN, QUAT, SCALE, SH = 0, 3, 7, 10
SUMS = SH + 3 * 16


class Pairs(NamedTuple):
    """Gradients of all pairs of splat and tile.

    first [images * N + 1] the number of each splat's first pair, and of all pairs; grads [pairs,
    10], see `splat`.
    """

    first: np.ndarray
    grads: np.ndarray


class Needs(NamedTuple):
    """Whether the gradients of SH and of the cameras are asked for."""

    sh: bool
    cameras: bool


class _Scratch(NamedTuple):
    """Room for one Gaussian.

    sums [58] its gradient over all views, see MEAN; functions [16] the SH functions at its
    direction, and g_functions [16] their gradients.
    """

    sums: np.ndarray
    functions: np.ndarray
    g_functions: np.ndarray


@kernel
def project_backward(start, stop, inputs, frame, needs, pairs, grads):
    """Compute the gradients of blocks start to stop of the scenes' Gaussians.

    Args:
        start, stop: blocks, numbered scene by scene.
        inputs: `Inputs`, as for `project`, but with quats and scales flat.
        frame: sizes and settings.
        needs: what is asked for beside the Gaussians' other fields.
        pairs: gradients of the pairs of splat and tile.
        grads: `Inputs` to write, float32 or float64: every element of the fields, those of SH if
            they are needed; of cameras [images, blocks, 16] float64, each block's part.
    """
    blocks, num = frame.blocks, frame.num
    count = inputs.sh.shape[1]
    splat_grads = np.empty(GRADIENT)
    first_pair, pair_grads = pairs
    grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_cameras = grads
    scratch = _Scratch(np.empty(SUMS), np.empty(16), np.empty(16))
    sums = scratch.sums
    for index in range(start, stop):
        scene, block = index // blocks, index % blocks
        for view in range(frame.views):
            grad_cameras[scene * frame.views + view, block] = 0
        for n in range(block * frame.block_size, min((block + 1) * frame.block_size, num)):
            g = scene * num + n
            _clear(sums)
            g_opacity = 0.0
            for view in range(frame.views):
                image = scene * frame.views + view
                d = image * num + n
                if first_pair[d] == first_pair[d + 1]:
                    continue
                _clear(splat_grads)
                for pair in range(first_pair[d], first_pair[d + 1]):
                    for k in range(GRADIENT):
                        splat_grads[k] += pair_grads[pair, k]
                g_camera = grad_cameras[image, block]
                g_opacity += _add_splat(
                    g, image, inputs, frame.project, needs, splat_grads, scratch, g_camera
                )
            grad_opacities[g] = g_opacity
            for k in range(3):
                grad_means[g, k], grad_scales[g, k] = sums[MEAN + k], sums[SCALE + k]
            for k in range(4):
                grad_quats[g, k] = sums[QUAT + k]
            if needs.sh:
                for k in range(count):
                    for channel in range(3):
                        grad_sh[g, k, channel] = sums[SH + 3 * k + channel]


@inline
def _clear(array):
    """Set all numbers to 0."""
    for k in range(len(array)):
        array[k] = 0.0


@inline
def _add3(out, start, factor, values):
    """Add factor values to out[start : start + 3]."""
    out[start] += factor * values[0]
    out[start + 1] += factor * values[1]
    out[start + 2] += factor * values[2]


@inline
def _add_splat(g, image, inputs, settings, needs, splat_grads, scratch, g_camera):
    """Add one splat's part to the sums and the camera's gradient; return that of the opacity.

    Args:
        g: the Gaussian.
        image: in which it is this splat.
        inputs: with quats and scales flat.
        settings: of the projection.
        needs: what is asked for.
        splat_grads: [10] of the splat.
        scratch: room, with the sums to add to.
        g_camera: [16].
    """
    eps = settings.eps2d
    sums, functions, g_functions = scratch
    camera = load_camera(inputs.cameras, image)
    right, down, forward, fx, fy = camera.right, camera.down, camera.forward, camera.fx, camera.fy

    # What `project` computed.
    mean = in_camera(camera, row3(inputs.means, g))
    offset, inverse_z, row_x, row_y = mean.offset, mean.inverse_z, mean.row_x, mean.row_y
    tangent_x, tangent_y = mean.tangent_x, mean.tangent_y
    inside_x, inside_y = mean.inside_x, mean.inside_y
    mx, my, turned_x, turned_y, scale = ellipse_rows(inputs.quats, inputs.scales, g, row_x, row_y)
    _, xy, yy, minors, det0, det = covariance(mx, my, eps)
    var_y = yy + eps
    a, b, c = whitening(xy, var_y, det)

    # Opacity, and antialiasing.
    opacity = float(inputs.opacities[g])
    g_det0 = g_det = 0.0
    g_opacity = splat_grads[G_LOG_OPACITY] / opacity
    if settings.antialiased and det0 > settings.compensation_min * det:
        half = 0.5 * splat_grads[G_LOG_OPACITY]  # log compensation = (log det0 - log det) / 2
        g_det0, g_det = half / det0, -half / det

    # Whitening to rows of M.
    factor = LOG_2 * WHITEN_TO_LOG2
    g_a, g_b, g_c = factor * splat_grads[G_A], factor * splat_grads[G_B], factor * splat_grads[G_C]
    g_var_y = (g_a * a - g_b * b - g_c * c) / (2 * var_y)
    g_xy = -g_b * a / var_y
    g_det -= (g_a * a + g_b * b) / (2 * det)
    g_minors = g_det0 + g_det
    g_xx, g_yy = eps * g_det, g_var_y + eps * g_det
    g_mx = plus(plus(scaled(2 * g_xx, mx), g_xy, my), 2 * g_minors, cross(my, minors))
    g_my = plus(plus(scaled(2 * g_yy, my), g_xy, mx), 2 * g_minors, cross(minors, mx))

    # Rows of M to scale, rotation and the Jacobian's rows.
    _add3(sums, SCALE, 1.0, plus(times(g_mx, turned_x), 1.0, times(g_my, turned_y)))
    h_x, h_y = times(g_mx, scale), times(g_my, scale)
    qw, qx, qy, qz, inverse = unit_quaternion(inputs.quats, 4 * g)
    axis0, axis1, axis2 = rotation_columns(qw, qx, qy, qz)
    turn = rotation_gradient(
        qw, qx, qy, qz, inverse,
        plus(scaled(h_x[0], row_x), h_y[0], row_y),
        plus(scaled(h_x[1], row_x), h_y[1], row_y),
        plus(scaled(h_x[2], row_x), h_y[2], row_y),
    )  # fmt: skip
    for k in range(4):
        sums[QUAT + k] += turn[k]
    g_row_x = plus(plus(scaled(h_x[0], axis0), h_x[1], axis1), h_x[2], axis2)
    g_row_y = plus(plus(scaled(h_y[0], axis0), h_y[1], axis1), h_y[2], axis2)

    # The Jacobian's rows and the center to the camera and the mean.
    g_x, g_y = LOG_2 * splat_grads[G_X], LOG_2 * splat_grads[G_Y]
    g_z = splat_grads[G_DEPTH]
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

    # Color.
    square = dot(offset, offset)
    length = math.sqrt(max(square, MIN_SQUARED_DISTANCE))
    direction = scaled(1 / length, offset)
    sh = inputs.sh
    count = sh.shape[1]
    write_sh_basis(direction[0], direction[1], direction[2], count, functions)
    _clear(g_functions)
    for channel in range(3):
        color = 0.5
        for k in range(count):
            color += functions[k] * float(sh[g, k, channel])
        if color > 0:
            g_color = splat_grads[G_RED + channel]
            for k in range(count):
                if needs.sh:
                    sums[SH + 3 * k + channel] += functions[k] * g_color
                g_functions[k] += float(sh[g, k, channel]) * g_color
    g_direction = sh_basis_gradient(direction[0], direction[1], direction[2], count, g_functions)
    g_offset = plus(g_offset, 1 / length, g_direction)
    if square > MIN_SQUARED_DISTANCE:
        g_offset = plus(g_offset, -dot(direction, g_direction) / length, direction)

    _add3(sums, MEAN, 1.0, g_offset)
    if needs.cameras:
        _add3(g_camera, RIGHT, 1.0, plus(scaled(g_u, offset), fx * inverse_z, g_row_x))
        _add3(g_camera, DOWN, 1.0, plus(scaled(g_v, offset), fy * inverse_z, g_row_y))
        through_x = plus(scaled(g_z, offset), -fx * inverse_z * inside_x, g_row_x)
        _add3(g_camera, FORWARD, 1.0, plus(through_x, -fy * inverse_z * inside_y, g_row_y))
        _add3(g_camera, CENTER, -1.0, g_offset)
        g_camera[FX] += g_fx
        g_camera[FY] += g_fy
        g_camera[CX] += g_cx
        g_camera[CY] += g_cy
    return g_opacity
