"""Compute gradients of Gaussians and cameras from those of their splats, in float64."""

import math
from typing import NamedTuple

import numpy as np

from asysplat.ops.simd.kernel import inline, kernel
from asysplat.rendering.cpu.math import (
    covariance,
    covariance_gradient,
    dot,
    ellipse_rows,
    ellipse_rows_gradient,
    load_camera,
    plus,
    project_mean,
    scaled,
    sh_basis_gradient,
    triple,
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
# Offsets of the gradients of mean, quaternion, scale and SH in a Gaussian's sums.
MEAN, QUAT, SCALE, SH = 0, 3, 7, 10
SUMS = SH + 3 * 16


class Pairs(NamedTuple):
    """Gradients of all pairs of splat and tile.

    first [images * N + 1] index of each splat's first pair, and the number of pairs; grads
    [pairs, 10], see `splat`.
    """

    first: np.ndarray
    grads: np.ndarray


class Needs(NamedTuple):
    """Whether SH and cameras require gradients."""

    sh: bool
    cameras: bool


class _Scratch(NamedTuple):
    """Buffers for one Gaussian.

    sums [58] its gradient over all views, see MEAN; basis [16] the SH functions in its direction,
    and g_basis [16] their gradients.
    """

    sums: np.ndarray
    basis: np.ndarray
    g_basis: np.ndarray


@kernel
def project_backward(start, stop, inputs, frame, needs, pairs, grads):
    """Compute the gradients of blocks start to stop of the scenes' Gaussians.

    Args:
        start, stop: blocks, numbered scene by scene.
        inputs: `Inputs`, as for `project`, but with flat quats and scales.
        frame: sizes and settings.
        needs: which gradients beside those of the Gaussians' other fields are required.
        pairs: gradients of the pairs of splat and tile.
        grads: `Inputs` to write, float32 or float64: every element of the fields, SH if required;
            cameras [images, blocks, 16] float64, the part of each block.
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
    """Add a splat's part to the sums and to the camera's gradient; return the opacity's gradient.

    Args:
        g: the Gaussian.
        image: the image of the splat.
        inputs: with flat quats and scales.
        settings: of the projection.
        needs: which gradients are required.
        splat_grads: [10] of the splat.
        scratch: buffers, with the sums to add to.
        g_camera: [16].
    """
    eps = settings.eps2d
    sums, basis, g_basis = scratch
    camera = load_camera(inputs.cameras, image)
    axes = camera.axes
    right, down, forward = axes
    fx, fy = camera.focal

    # Repeat the forward pass.
    mean = triple(inputs.means[g], 0)
    offset, _, inverse_z, tangents, clamped, row_x, row_y = project_mean(
        mean, axes, camera.center, (fx, fy), camera.limits
    )
    quat, scale = unit_quaternion(inputs.quats, 4 * g), triple(inputs.scales, 3 * g)
    mx, my, _, _ = ellipse_rows(quat, scale, row_x, row_y)
    _, xy, yy, _, det0, det = covariance(mx, my, eps)

    # Opacity, and antialiasing.
    opacity = float(inputs.opacities[g])
    g_det0 = g_det = 0.0
    g_opacity = splat_grads[G_LOG_OPACITY] / opacity
    if settings.antialiased and det0 > settings.compensation_min * det:
        half = 0.5 * splat_grads[G_LOG_OPACITY]  # log compensation = (log det0 - log det) / 2
        g_det0, g_det = half / det0, -half / det

    # Whitening, covariance, scale and rotation.
    factor = LOG_2 * WHITEN_TO_LOG2
    g_abc = (factor * splat_grads[G_A], factor * splat_grads[G_B], factor * splat_grads[G_C])
    abc = whitening(xy, yy + eps, det)
    g_mx, g_my = covariance_gradient(g_abc, g_det0, g_det, abc, mx, my, eps)
    g_scale, g_quat, g_row_x, g_row_y = ellipse_rows_gradient(g_mx, g_my, quat, scale, row_x, row_y)
    _add3(sums, SCALE, 1.0, g_scale)
    for k in range(4):
        sums[QUAT + k] += g_quat[k]

    # The Jacobian's rows and the center.
    g_x, g_y = LOG_2 * splat_grads[G_X], LOG_2 * splat_grads[G_Y]
    g_z = splat_grads[G_DEPTH]
    g_z -= inverse_z * (dot(row_x, g_row_x) + dot(row_y, g_row_y))
    g_fx = g_x * tangents[0] + dot(row_x, g_row_x) / fx
    g_fy = g_y * tangents[1] + dot(row_y, g_row_y) / fy
    g_cx, g_cy = g_x, g_y
    g_clamped_x = -fx * inverse_z * dot(forward, g_row_x)
    g_clamped_y = -fy * inverse_z * dot(forward, g_row_y)
    g_tangent_x, g_tangent_y = g_x * fx, g_y * fy
    if clamped[0] == tangents[0]:
        g_tangent_x += g_clamped_x
    else:  # the limit is (constant - cx) / fx
        g_cx -= g_clamped_x / fx
        g_fx -= g_clamped_x * clamped[0] / fx
    if clamped[1] == tangents[1]:
        g_tangent_y += g_clamped_y
    else:
        g_cy -= g_clamped_y / fy
        g_fy -= g_clamped_y * clamped[1] / fy
    g_z -= inverse_z * (g_tangent_x * tangents[0] + g_tangent_y * tangents[1])
    g_u, g_v = g_tangent_x * inverse_z, g_tangent_y * inverse_z
    g_offset = plus(plus(scaled(g_u, right), g_v, down), g_z, forward)

    # Color.
    square = dot(offset, offset)
    length = math.sqrt(max(square, MIN_SQUARED_DISTANCE))
    direction = scaled(1 / length, offset)
    sh = inputs.sh
    count = sh.shape[1]
    write_sh_basis(direction[0], direction[1], direction[2], count, basis)
    _clear(g_basis)
    for channel in range(3):
        color = 0.5
        for k in range(count):
            color += basis[k] * float(sh[g, k, channel])
        if color > 0:
            g_color = splat_grads[G_RED + channel]
            for k in range(count):
                if needs.sh:
                    sums[SH + 3 * k + channel] += basis[k] * g_color
                g_basis[k] += float(sh[g, k, channel]) * g_color
    g_direction = sh_basis_gradient(direction[0], direction[1], direction[2], count, g_basis)
    g_offset = plus(g_offset, 1 / length, g_direction)
    if square > MIN_SQUARED_DISTANCE:
        g_offset = plus(g_offset, -dot(direction, g_direction) / length, direction)

    _add3(sums, MEAN, 1.0, g_offset)
    if needs.cameras:
        _add3(g_camera, RIGHT, 1.0, plus(scaled(g_u, offset), fx * inverse_z, g_row_x))
        _add3(g_camera, DOWN, 1.0, plus(scaled(g_v, offset), fy * inverse_z, g_row_y))
        through_x = plus(scaled(g_z, offset), -fx * inverse_z * clamped[0], g_row_x)
        _add3(g_camera, FORWARD, 1.0, plus(through_x, -fy * inverse_z * clamped[1], g_row_y))
        _add3(g_camera, CENTER, -1.0, g_offset)
        g_camera[FX] += g_fx
        g_camera[FY] += g_fy
        g_camera[CX] += g_cx
        g_camera[CY] += g_cy
    return g_opacity
