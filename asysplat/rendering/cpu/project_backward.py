"""Compute gradients of Gaussians and cameras from those of their splats, in float64."""

import math

import numpy as np

from asysplat.geometry.spherical_harmonics import MIN_SQUARED_DISTANCE
from asysplat.kernels.simd.threads import inline, kernel
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.math import (
    covariance,
    covariance_gradient,
    dot,
    ellipse_rows,
    ellipse_rows_gradient,
    load_camera,
    plus,
    project_mean,
    project_mean_gradient,
    scaled,
    sh_basis_gradient,
    triple,
    unit_quaternion,
    whitening,
    write_sh_basis,
)
from asysplat.rendering.formulas import CENTER, CX, CY, DOWN, FORWARD, FX, FY, RIGHT, WHITEN_TO_LOG2

LOG_2 = math.log(2)
# Offsets of the gradients of mean, quaternion, scale and SH in a Gaussian's sums.
MEAN, QUAT, SCALE, SH = 0, 3, 7, 10
SUMS = SH + 3 * 16


@kernel
def project_backward(start, stop, inputs, frame, first_pair, pair_grads, needs, grads):
    """Compute the gradients of blocks start to stop of the Gaussians, numbered scene by scene.

    inputs have flat quats and scales; needs says whether SH and cameras require gradients. Every
    element of the fields in `grads`, float32 or float64, is written, SH only if required; cameras
    [images, blocks, 16] float64 get the part of each block.
    """
    blocks, num = frame.blocks, frame.num
    count = inputs.sh.shape[1]
    splat_grads = np.empty(col.GRADIENT)
    grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_cameras = grads
    sums, basis, g_basis = np.empty(SUMS), np.empty(16), np.empty(16)
    scratch = (sums, basis, g_basis)
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
                    for k in range(col.GRADIENT):
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
            if needs[0]:
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
    """Add the part of Gaussian g's splat in an image to the sums; return the opacity's gradient."""
    eps = settings.eps2d
    sums, basis, g_basis = scratch
    axes, center, focal, limits, _ = load_camera(inputs.cameras, image)

    # Repeat the forward pass.
    mean = triple(inputs.means[g], 0)
    offset, _, inverse_z, tangents, clamped, row_x, row_y = project_mean(
        mean, axes, center, focal, limits
    )
    quat, scale = unit_quaternion(inputs.quats, 4 * g), triple(inputs.scales, 3 * g)
    mx, my, _, _ = ellipse_rows(quat, scale, row_x, row_y)
    _, xy, yy, _, det0, det = covariance(mx, my, eps)

    # Opacity, and antialiasing.
    opacity = np.float64(inputs.opacities[g])
    g_det0 = g_det = 0.0
    g_opacity = splat_grads[col.G_LOG_OPACITY] / opacity
    if settings.antialiased and det0 > settings.compensation_min * det:
        half = 0.5 * splat_grads[col.G_LOG_OPACITY]  # log compensation = (log det0 - log det) / 2
        g_det0, g_det = half / det0, -half / det

    # Whitening, covariance, scale and rotation.
    factor = LOG_2 * WHITEN_TO_LOG2
    g_abc = (
        factor * splat_grads[col.G_A],
        factor * splat_grads[col.G_B],
        factor * splat_grads[col.G_C],
    )
    abc = whitening(xy, yy + eps, det)
    g_mx, g_my = covariance_gradient(g_abc, g_det0, g_det, abc, mx, my, eps)
    g_scale, g_quat, g_row_x, g_row_y = ellipse_rows_gradient(g_mx, g_my, quat, scale, row_x, row_y)
    _add3(sums, SCALE, 1.0, g_scale)
    for k in range(4):
        sums[QUAT + k] += g_quat[k]

    # The Jacobian's rows, and center and depth.
    g_xyz = (LOG_2 * splat_grads[col.G_X], LOG_2 * splat_grads[col.G_Y], splat_grads[col.G_DEPTH])
    projected = (offset, inverse_z, tangents, clamped)
    g_offset, g_axes, g_focal, g_principal = project_mean_gradient(
        g_xyz, (g_row_x, g_row_y), (row_x, row_y), projected, axes, focal
    )

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
            color += basis[k] * np.float64(sh[g, k, channel])
        if color > 0:
            g_color = splat_grads[col.G_RED + channel]
            for k in range(count):
                if needs[0]:
                    sums[SH + 3 * k + channel] += basis[k] * g_color
                g_basis[k] += np.float64(sh[g, k, channel]) * g_color
    g_direction = sh_basis_gradient(direction[0], direction[1], direction[2], count, g_basis)
    g_offset = plus(g_offset, 1 / length, g_direction)
    if square > MIN_SQUARED_DISTANCE:
        g_offset = plus(g_offset, -dot(direction, g_direction) / length, direction)

    _add3(sums, MEAN, 1.0, g_offset)
    if needs[1]:
        _add3(g_camera, RIGHT, 1.0, g_axes[0])
        _add3(g_camera, DOWN, 1.0, g_axes[1])
        _add3(g_camera, FORWARD, 1.0, g_axes[2])
        _add3(g_camera, CENTER, -1.0, g_offset)
        g_camera[FX] += g_focal[0]
        g_camera[FY] += g_focal[1]
        g_camera[CX] += g_principal[0]
        g_camera[CY] += g_principal[1]
    return g_opacity
