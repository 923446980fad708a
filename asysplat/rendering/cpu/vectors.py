"""Three numbers as a tuple, and quaternions."""

import math

from asysplat.rendering.cpu.kernel import inline


@inline
def row3(array, row, column=0):
    """Three float64 from a row of an array."""
    return (float(array[row, column]), float(array[row, column + 1]), float(array[row, column + 2]))


@inline
def triple(array, start):
    """Three float64 from a flat array."""
    return (float(array[start]), float(array[start + 1]), float(array[start + 2]))


@inline
def dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@inline
def cross(p, q):
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


@inline
def scaled(factor, p):
    return (factor * p[0], factor * p[1], factor * p[2])


@inline
def plus(p, factor, q):
    """p + factor q."""
    return (p[0] + factor * q[0], p[1] + factor * q[1], p[2] + factor * q[2])


@inline
def times(p, q):
    return (p[0] * q[0], p[1] * q[1], p[2] * q[2])


@inline
def unit_quaternion(quats, start):
    """Its four numbers, from a flat array, and 1 / its length."""
    w, x, y, z = (
        float(quats[start]),
        float(quats[start + 1]),
        float(quats[start + 2]),
        float(quats[start + 3]),
    )
    inverse = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inline
def rotation_columns(w, x, y, z):
    """The images of the three axes under a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@inline
def rotation_gradient(w, x, y, z, inverse, g0, g1, g2):
    """Gradient of the quaternion, of any length, from those of the three columns."""
    gw = 2 * (x * (g1[2] - g2[1]) + y * (g2[0] - g0[2]) + z * (g0[1] - g1[0]))
    gx = 2 * (
        y * (g0[1] + g1[0]) + z * (g0[2] + g2[0]) + w * (g1[2] - g2[1]) - 2 * x * (g1[1] + g2[2])
    )
    gy = 2 * (
        x * (g0[1] + g1[0]) + z * (g1[2] + g2[1]) + w * (g2[0] - g0[2]) - 2 * y * (g0[0] + g2[2])
    )
    gz = 2 * (
        x * (g0[2] + g2[0]) + y * (g1[2] + g2[1]) + w * (g0[1] - g1[0]) - 2 * z * (g0[0] + g1[1])
    )
    radial = w * gw + x * gx + y * gy + z * gz
    return (
        inverse * (gw - radial * w),
        inverse * (gx - radial * x),
        inverse * (gy - radial * y),
        inverse * (gz - radial * z),
    )
