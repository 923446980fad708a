"""From Gaussians to their ellipses on the image, in float64: what both passes compute."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering import camera_rows as cam
from asysplat.rendering.cuda.vectors import (
    cross,
    dot,
    load_row3,
    plus,
    rotation_columns,
    scaled,
    times,
)

RIGHT, DOWN = tl.constexpr(cam.RIGHT), tl.constexpr(cam.DOWN)
FORWARD, CENTER = tl.constexpr(cam.FORWARD), tl.constexpr(cam.CENTER)
FX, FY, CX, CY = (tl.constexpr(k) for k in (cam.FX, cam.FY, cam.CX, cam.CY))
LOW_X, HIGH_X, LOW_Y, HIGH_Y = (
    tl.constexpr(k) for k in (cam.LOW_X, cam.HIGH_X, cam.LOW_Y, cam.HIGH_Y)
)
CAMERA, CAMERA_GRADIENT = tl.constexpr(cam.CAMERA), tl.constexpr(cam.CAMERA_GRADIENT)
TINY = tl.constexpr(1e-20)  # below the square of any distance that matters


@kernel
def clamp(value, low, high):
    """`value` where NaN or between."""
    return tl.where(value < low, low, tl.where(value > high, high, value))


@kernel
def in_camera(camera, mean):
    """From the camera's centre to the mean, in world axes; x / z, y / z, z, 1 / z in the camera's
    frame; the tangents that the Jacobian is taken at, and its rows in world axes."""
    right, down = load_row3(camera, RIGHT), load_row3(camera, DOWN)
    forward, center = load_row3(camera, FORWARD), load_row3(camera, CENTER)
    # Relative to the camera first: exact for scenes far from the origin.
    offset = plus(mean, -1.0, center)
    z = dot(forward, offset)
    inverse_z = 1 / z
    tangent_x, tangent_y = dot(right, offset) * inverse_z, dot(down, offset) * inverse_z
    inside_x = clamp(tangent_x, tl.load(camera + LOW_X), tl.load(camera + HIGH_X))
    inside_y = clamp(tangent_y, tl.load(camera + LOW_Y), tl.load(camera + HIGH_Y))
    row_x = scaled(tl.load(camera + FX) * inverse_z, plus(right, -inside_x, forward))
    row_y = scaled(tl.load(camera + FY) * inverse_z, plus(down, -inside_y, forward))
    return offset, tangent_x, tangent_y, z, inverse_z, inside_x, inside_y, row_x, row_y


@kernel
def ellipse_rows(quat, scale, row_x, row_y):
    """Rows of M in the covariance M M^T, in pixels, before and after they are scaled."""
    axis0, axis1, axis2 = rotation_columns(quat[0], quat[1], quat[2], quat[3])
    turned_x = (dot(row_x, axis0), dot(row_x, axis1), dot(row_x, axis2))
    turned_y = (dot(row_y, axis0), dot(row_y, axis1), dot(row_y, axis2))
    return times(turned_x, scale), times(turned_y, scale), turned_x, turned_y


@kernel
def covariance(mx, my, eps):
    """xx, xy, yy of M M^T; its determinant by Cauchy-Binet; that of M M^T + eps I."""
    xx, xy, yy = dot(mx, mx), dot(mx, my), dot(my, my)
    minors = cross(mx, my)
    det0 = dot(minors, minors)
    return xx, xy, yy, minors, det0, det0 + eps * (xx + yy) + eps * eps


@kernel
def whitening(xy, var_y, det):
    """a, b, c of the exponent ((a dx + b dy)^2 + (c dy)^2) / 2."""
    a = tl.sqrt(var_y / det)
    return a, -a * xy / var_y, 1 / tl.sqrt(var_y)


@kernel
def direction_of(offset):
    """Its length, and its square; the unit vector, in float32."""
    square = dot(offset, offset)
    length = tl.sqrt(tl.maximum(square, TINY))
    x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    return square, length, x.to(tl.float32), y.to(tl.float32), z.to(tl.float32)
