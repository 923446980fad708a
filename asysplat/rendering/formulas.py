"""What the fast backends share: constants, and arithmetic that the compilers of both take, of three
numbers as a tuple and of rotations."""

import math

WHITEN_TO_LOG2 = math.sqrt(0.5 / math.log(2))  # exp(-x^2 / 2) = 2^-(WHITEN_TO_LOG2 x)^2

Y0 = 0.5 / math.sqrt(math.pi)
Y1 = math.sqrt(3 / (4 * math.pi))
Y2 = 0.5 * math.sqrt(15 / math.pi)
Y2_0 = 0.25 * math.sqrt(5 / math.pi)
Y3_3 = 0.25 * math.sqrt(35 / (2 * math.pi))
Y3_2 = 0.5 * math.sqrt(105 / math.pi)
Y3_1 = 0.25 * math.sqrt(21 / (2 * math.pi))
Y3_0 = 0.25 * math.sqrt(7 / math.pi)


def dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def cross(p, q):
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


def scaled(factor, p):
    return (factor * p[0], factor * p[1], factor * p[2])


def plus(p, factor, q):
    """p + factor q."""
    return (p[0] + factor * q[0], p[1] + factor * q[1], p[2] + factor * q[2])


def times(p, q):
    return (p[0] * q[0], p[1] * q[1], p[2] * q[2])


def rotation_columns(w, x, y, z):
    """The images of the three axes under a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def rotation_gradient(w, x, y, z, inverse, g0, g1, g2):
    """Gradient of the quaternion, of length 1 / inverse, from those of the three columns."""
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
