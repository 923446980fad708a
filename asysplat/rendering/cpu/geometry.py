"""From a Gaussian to its ellipse on the image, in float64: what both passes compute."""

import math

from asysplat.ops.cpu.kernel import inline
from asysplat.rendering.cpu.vectors import (
    cross,
    dot,
    plus,
    rotation_columns,
    scaled,
    times,
    triple,
    unit_quaternion,
)


@inline
def clamp(value, low, high):
    """`value` where NaN or between."""
    return low if value < low else high if value > high else value


@inline
def jacobian_row(axis, forward, focal, inverse_z, tangent):
    """How a pixel coordinate moves with the mean, in world axes."""
    return scaled(focal * inverse_z, plus(axis, -tangent, forward))


@inline
def ellipse_rows(quats, scales, g, row_x, row_y):
    """Rows of M in the covariance M M^T, in pixels, and what they were made from; of Gaussian g in
    flat arrays."""
    w, x, y, z, _ = unit_quaternion(quats, 4 * g)
    axis0, axis1, axis2 = rotation_columns(w, x, y, z)
    turned_x = (dot(row_x, axis0), dot(row_x, axis1), dot(row_x, axis2))
    turned_y = (dot(row_y, axis0), dot(row_y, axis1), dot(row_y, axis2))
    scale = triple(scales, 3 * g)
    return times(turned_x, scale), times(turned_y, scale), turned_x, turned_y, scale


@inline
def covariance(mx, my, eps):
    """xx, xy, yy of M M^T; its determinant by Cauchy-Binet; that of M M^T + eps I."""
    xx, xy, yy = dot(mx, mx), dot(mx, my), dot(my, my)
    minors = cross(mx, my)
    det0 = dot(minors, minors)
    return xx, xy, yy, minors, det0, det0 + eps * (xx + yy) + eps * eps


@inline
def whitening(xy, var_y, det):
    """a, b, c of the exponent ((a dx + b dy)^2 + (c dy)^2) / 2."""
    a = math.sqrt(var_y / det)
    return a, -a * xy / var_y, 1 / math.sqrt(var_y)


@inline
def compensation(det0, det, floor):
    """What antialiasing takes off the opacity (Yu et al. 2024, Mip-Splatting)."""
    return math.sqrt(max(det0 / det, floor))
