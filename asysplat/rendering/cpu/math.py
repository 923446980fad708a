"""Arithmetic of the renderer's kernels: cameras, ellipses, spherical harmonics (SH), bits.

All that the two projection passes share is here, in float64.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from asysplat.ops.simd.kernel import inline
from asysplat.ops.simd.vectors import FLOATS, LANES, sum_of, vector_at
from asysplat.rendering import formulas, sh

SQRT_2, TWO_OVER_LN_2 = math.sqrt(2), 2 / math.log(2)

dot = inline(formulas.dot)
cross = inline(formulas.cross)
scaled = inline(formulas.scaled)
plus = inline(formulas.plus)
times = inline(formulas.times)
rotation_columns = inline(formulas.rotation_columns)
rotation_gradient = inline(formulas.rotation_gradient)
write_sh_basis = inline(sh.write_sh_basis)
sh_basis_gradient = inline(sh.sh_basis_gradient)


@inline
def row3(array, row, column=0):
    """Read three float64 from a row of an array."""
    return (float(array[row, column]), float(array[row, column + 1]), float(array[row, column + 2]))


@inline
def triple(array, start):
    """Read three float64 from a flat array."""
    return (float(array[start]), float(array[start + 1]), float(array[start + 2]))


@inline
def unit_quaternion(quats, start):
    """Read a quaternion from a flat array; return its unit quaternion and 1 / its length."""
    w, x, y, z = (
        float(quats[start]),
        float(quats[start + 1]),
        float(quats[start + 2]),
        float(quats[start + 3]),
    )
    inverse = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inline
def clamp(value, low, high):
    """Limit `value` to [low, high]; NaN stays."""
    return low if value < low else high if value > high else value


class Camera(NamedTuple):
    """A row of `camera_rows`: axes and center in the world, intrinsics, limits of the tangents."""

    right: tuple[float, float, float]
    down: tuple[float, float, float]
    forward: tuple[float, float, float]
    center: tuple[float, float, float]
    fx: float
    fy: float
    cx: float
    cy: float
    low_x: float
    high_x: float
    low_y: float
    high_y: float


@inline
def load_camera(cameras, image):
    """Read the camera of an image."""
    return Camera(
        right=row3(cameras, image, formulas.RIGHT),
        down=row3(cameras, image, formulas.DOWN),
        forward=row3(cameras, image, formulas.FORWARD),
        center=row3(cameras, image, formulas.CENTER),
        fx=cameras[image, formulas.FX],
        fy=cameras[image, formulas.FY],
        cx=cameras[image, formulas.CX],
        cy=cameras[image, formulas.CY],
        low_x=cameras[image, formulas.LOW_X],
        high_x=cameras[image, formulas.HIGH_X],
        low_y=cameras[image, formulas.LOW_Y],
        high_y=cameras[image, formulas.HIGH_Y],
    )


class InCamera(NamedTuple):
    """A mean as a camera sees it.

    The offset is from the camera's center, in world axes; tangents are x / z and y / z; inside are
    those that the Jacobian is taken at; rows are the Jacobian's, in world axes.
    """

    offset: tuple[float, float, float]
    z: float
    inverse_z: float
    tangent_x: float
    tangent_y: float
    inside_x: float
    inside_y: float
    row_x: tuple[float, float, float]
    row_y: tuple[float, float, float]


@inline
def in_camera(camera, mean):
    """Project a mean and linearize the projection around it."""
    # Relative to the camera first: exact for scenes far from the origin.
    offset = plus(mean, -1.0, camera.center)
    z = dot(camera.forward, offset)
    inverse_z = 1 / z
    tangent_x = dot(camera.right, offset) * inverse_z
    tangent_y = dot(camera.down, offset) * inverse_z
    inside_x = clamp(tangent_x, camera.low_x, camera.high_x)
    inside_y = clamp(tangent_y, camera.low_y, camera.high_y)
    return InCamera(
        offset=offset,
        z=z,
        inverse_z=inverse_z,
        tangent_x=tangent_x,
        tangent_y=tangent_y,
        inside_x=inside_x,
        inside_y=inside_y,
        row_x=scaled(camera.fx * inverse_z, plus(camera.right, -inside_x, camera.forward)),
        row_y=scaled(camera.fy * inverse_z, plus(camera.down, -inside_y, camera.forward)),
    )


@inline
def ellipse_rows(quats, scales, g, row_x, row_y):
    """Return the rows of M in the covariance M M^T, in pixels, of Gaussian g in flat arrays.

    Also what they are made from: the rows before they are scaled, and the scale.
    """
    w, x, y, z, _ = unit_quaternion(quats, 4 * g)
    axis0, axis1, axis2 = rotation_columns(w, x, y, z)
    turned_x = (dot(row_x, axis0), dot(row_x, axis1), dot(row_x, axis2))
    turned_y = (dot(row_y, axis0), dot(row_y, axis1), dot(row_y, axis2))
    scale = triple(scales, 3 * g)
    return times(turned_x, scale), times(turned_y, scale), turned_x, turned_y, scale


@inline
def covariance(mx, my, eps):
    """Return xx, xy, yy of M M^T; M's minors; the determinants of M M^T and of M M^T + eps I.

    The determinant is the sum of the squared minors (Cauchy-Binet): no needle makes it cancel.
    """
    xx, xy, yy = dot(mx, mx), dot(mx, my), dot(my, my)
    minors = cross(mx, my)
    det0 = dot(minors, minors)
    return xx, xy, yy, minors, det0, det0 + eps * (xx + yy) + eps * eps


@inline
def whitening(xy, var_y, det):
    """Return a, b, c of the exponent ((a dx + b dy)^2 + (c dy)^2) / 2."""
    a = math.sqrt(var_y / det)
    return a, -a * xy / var_y, 1 / math.sqrt(var_y)


@inline
def compensation(det0, det, floor):
    """Return the factor that antialiasing lowers the opacity by (Yu et al. 2024, Mip-Splatting)."""
    return math.sqrt(max(det0 / det, floor))


@intrinsic
def to_bits(typing_context, value):
    """Return the bits of a float32 as int32."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), generate


@intrinsic
def from_bits(typing_context, value):
    """Return the float32 of these bits."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@inline
def log2(x):
    """Compute log2 of a positive float64, rounded to float32 first, to 1e-9."""
    bits = to_bits(np.float32(x))
    exponent = (bits >> np.int32(23)) - np.int32(127)
    mantissa = float(from_bits((bits & np.int32(0x7FFFFF)) | np.int32(0x3F800000)))
    # From [1, 2) to around 1.
    high = mantissa > SQRT_2
    mantissa = 0.5 * mantissa if high else mantissa
    t = (mantissa - 1) / (mantissa + 1)
    square = t * t
    series = 1 + square * (1 / 3 + square * (1 / 5 + square * (1 / 7 + square / 9)))
    return float(exponent) + (1.0 if high else 0.0) + TWO_OVER_LN_2 * t * series


@intrinsic
def take_sum(typing_context, state, base):
    """Return the sum of the LANES numbers from `base` on, and set them to 0 for the next splat."""

    def generate(context, builder, signature, args):
        pointer = vector_at(context, builder, signature, args, step=1)
        vector = builder.load(pointer, align=4)
        builder.store(ir.Constant(FLOATS, [0.0] * LANES), pointer, align=4)
        return sum_of(builder, vector)

    return types.float32(state, base), generate
