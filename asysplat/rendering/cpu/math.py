"""Arithmetic of both projection passes, in float64: cameras, ellipses, spherical harmonics (SH)."""

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from asysplat.geometry import spherical_harmonics as sh
from asysplat.kernels.simd.threads import inline
from asysplat.kernels.simd.vectors import ZEROS, emit_sum, vector_at
from asysplat.rendering import formulas

SQRT_2, TWO_OVER_LN_2 = math.sqrt(2), 2 / math.log(2)

sqrt = math.sqrt


def inline_formula(formula):
    """Compile a shared formula into each kernel that calls it."""
    return inline(formulas.bind(formula, globals()))


clamp = inline_formula(formulas.clamp)
select = inline_formula(formulas.select)
dot = inline_formula(formulas.dot)
cross = inline_formula(formulas.cross)
scaled = inline_formula(formulas.scaled)
plus = inline_formula(formulas.plus)
times = inline_formula(formulas.times)
rotation_columns = inline_formula(formulas.rotation_columns)
rotation_gradient = inline_formula(formulas.rotation_gradient)
project_mean = inline_formula(formulas.project_mean)
project_mean_gradient = inline_formula(formulas.project_mean_gradient)
ellipse_rows = inline_formula(formulas.ellipse_rows)
ellipse_rows_gradient = inline_formula(formulas.ellipse_rows_gradient)
covariance = inline_formula(formulas.covariance)
covariance_gradient = inline_formula(formulas.covariance_gradient)
whitening = inline_formula(formulas.whitening)
write_sh_basis = inline(sh.write_sh_basis)
sh_basis_gradient = inline(sh.sh_basis_gradient)


@inline
def triple(array, start):
    """Read three float64 from a flat array."""
    # Numba's float() would leave them in float32.
    return np.float64(array[start]), np.float64(array[start + 1]), np.float64(array[start + 2])


@inline
def unit_quaternion(quats, start):
    """Read a quaternion from a flat array; return its unit quaternion and 1 / its length."""
    w, x, y = triple(quats, start)
    z = np.float64(quats[start + 3])
    inverse = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inline
def load_camera(cameras, image):
    """Read axes (right, down, forward), center, focal lengths, limits and principal point."""
    row = cameras[image]
    axes = (triple(row, formulas.RIGHT), triple(row, formulas.DOWN), triple(row, formulas.FORWARD))
    focal, principal = (row[formulas.FX], row[formulas.FY]), (row[formulas.CX], row[formulas.CY])
    limits_x = (row[formulas.LOW_X], row[formulas.HIGH_X])
    limits_y = (row[formulas.LOW_Y], row[formulas.HIGH_Y])
    return axes, triple(row, formulas.CENTER), focal, (limits_x, limits_y), principal


@intrinsic
def to_bits(typing_context, value):
    """Return the bits of a float32 as int32."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), generate


@intrinsic
def from_bits(typing_context, value):
    """Return the float32 with these bits."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@inline
def log2(x):
    """Compute log2 of a positive float64, which is first rounded to float32, to 1e-9."""
    bits = to_bits(np.float32(x))
    exponent = (bits >> np.int32(23)) - np.int32(127)
    mantissa = np.float64(from_bits((bits & np.int32(0x7FFFFF)) | np.int32(0x3F800000)))
    # Move the mantissa from [1, 2) to around 1.
    high = mantissa > SQRT_2
    mantissa = 0.5 * mantissa if high else mantissa
    t = (mantissa - 1) / (mantissa + 1)
    square = t * t
    series = 1 + square * (1 / 3 + square * (1 / 5 + square * (1 / 7 + square / 9)))
    return float(exponent) + (1.0 if high else 0.0) + TWO_OVER_LN_2 * t * series


@intrinsic
def sum_and_clear(typing_context, state, base):
    """Return the sum of the LANES numbers from `base` on, and set them to 0."""

    def generate(context, builder, signature, args):
        pointer = vector_at(context, builder, signature, args, step=1)
        vector = builder.load(pointer, align=4)
        builder.store(ZEROS, pointer, align=4)
        return emit_sum(builder, vector)

    return types.float32(state, base), generate
