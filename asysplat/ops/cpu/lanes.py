"""Float32 arithmetic of the inner loops, which the compiler turns into whole vectors.

Products and sums are fused by name and never by the compiler's choice, so that the forward and the
backward pass, which share these functions, take identical decisions.
"""

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from asysplat.ops.cpu.kernel import inline
from asysplat.ops.cpu.vectors import FLOATS, INTEGERS, LANES, VECTOR, fma, sum_of, vector_at

FLOAT, FLOAT_BITS = ir.FloatType(), ir.IntType(32)

SQRT_2, TWO_OVER_LN_2 = math.sqrt(2), 2 / math.log(2)
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
MIDDLE = np.float32((LANES - 1) / 2)
# Added and taken away again, it rounds a float32 to an integer that stands in its lowest bits.
ROUND = np.float32(1.5 * 2**23)
LOWEST = np.float32(-64)  # 2 ** LOWEST is below every threshold and still a normal number
UNDERFLOW = np.float32(-127)  # its exponent's bits, and with them all bits of `exp2`, are 0
# 2^f on [-1/2, 1/2]: the Chebyshev interpolation, relative error 2e-9.
P0, P1, P2, P3, P4, P5, P6 = (
    np.float32(c)
    for c in (
        1.00000000059202,
        0.6931472056005139,
        0.24022646608715542,
        0.05550328997510684,
        0.009618519534332742,
        0.00133998603653958,
        0.00015337576817951937,
    )
)


@intrinsic
def add_to_exponent(typing_context, value, number):
    """value * 2^n, where n stands in the lowest bits of `number`."""

    def generate(context, builder, signature, args):
        bits = INTEGERS if value == VECTOR else FLOAT_BITS
        value_bits, number_bits = (builder.bitcast(arg, bits) for arg in args)
        shift = ir.Constant(bits, [23] * LANES if value == VECTOR else 23)
        total = builder.add(value_bits, builder.shl(number_bits, shift))
        return builder.bitcast(total, args[0].type)

    return value(value, value), generate


@intrinsic
def to_bits(typing_context, value):
    """The bits of a float32 as int32."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], FLOAT_BITS)

    return types.int32(types.float32), generate


@intrinsic
def from_bits(typing_context, value):
    """The float32 of these bits."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], FLOAT)

    return types.float32(types.int32), generate


@intrinsic
def take_sum(typing_context, state, base):
    """Sum of the LANES numbers from `base` on, which are left at 0 for the next splat."""

    def generate(context, builder, signature, args):
        pointer = vector_at(context, builder, signature, args, step=1)
        vector = builder.load(pointer, align=4)
        builder.store(ir.Constant(FLOATS, [0.0] * LANES), pointer, align=4)
        return sum_of(builder, vector)

    return types.float32(state, base), generate


@intrinsic
def prefetch(typing_context, rows, row):
    """Ask for a row of a 2D array before it is needed."""

    def generate(context, builder, signature, args):
        array_type, row_type = signature.args
        array = context.make_array(array_type)(context, builder, args[0])
        row = context.cast(builder, args[1], row_type, types.intp)
        stride = builder.extract_value(array.strides, 0)
        byte = builder.bitcast(array.data, ir.IntType(8).as_pointer())
        pointer = builder.gep(byte, [builder.mul(row, stride)])
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, *[ir.IntType(32)] * 3])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, keep, data = (ir.IntType(32)(value) for value in (0, 3, 1))
        builder.call(function, [pointer, read, keep, data])
        return context.get_dummy_value()

    return types.void(rows, row), generate


@inline
def exp2(x):
    """2^x for x from -126 to 126, to 8e-8 of itself."""
    shifted = x + ROUND
    f = x - (shifted - ROUND)
    p = fma(P6, f, P5)
    p = fma(p, f, P4)
    p = fma(p, f, P3)
    p = fma(p, f, P2)
    p = fma(p, f, P1)
    p = fma(p, f, P0)
    return add_to_exponent(p, shifted)


@inline
def decay2(x):
    """2^x for x <= 0, to 8e-8 of itself or 1e-38; 0 from UNDERFLOW on."""
    return exp2(max(x, UNDERFLOW))


@inline
def log2(x):
    """log2 of a positive float64, rounded to float32 first, to 1e-9."""
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


@inline
def alpha_at(u, row_exponent, alpha_min, alpha_max):
    """Alpha of a pixel, 0 below alpha_min: 2^(row_exponent - u^2)."""
    exponent = max(fma(-u, u, row_exponent), LOWEST)
    alpha = min(exp2(exponent), alpha_max)
    return alpha if alpha >= alpha_min else ZERO
