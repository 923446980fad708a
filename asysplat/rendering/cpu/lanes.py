"""Float32 arithmetic of the inner loops, which the compiler turns into whole vectors.

Products and sums are fused by name and never by the compiler's choice, so that the forward and the
backward pass, which share these functions, take identical decisions.
"""

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from asysplat.rendering.cpu.kernel import inline

LANES = 16  # pixels of a tile's row, one vector of AVX-512
FLOAT32_BITS = ir.IntType(32)
HAS_FMA = bool(llvmlite.binding.get_host_cpu_features().get("fma", True))

ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
MIDDLE = np.float32((LANES - 1) / 2)
# Added and taken away again, it rounds a float32 to an integer that stands in its lowest bits.
ROUND = np.float32(1.5 * 2**23)
LOWEST = np.float32(-64)  # 2 ** LOWEST is below every threshold and still a normal number
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
def fma(typing_context, a, b, c):
    """a * b + c, rounded once where the processor can do that."""

    def generate(context, builder, signature, args):
        if HAS_FMA:
            return builder.fma(*args)
        return builder.fadd(builder.fmul(args[0], args[1]), args[2])

    return a(a, a, a), generate


@intrinsic
def to_bits(typing_context, value):
    """The bits of a float32 as int32."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], FLOAT32_BITS)

    return types.int32(types.float32), generate


@intrinsic
def from_bits(typing_context, value):
    """The float32 of these bits."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@inline
def exp2(x):
    """2^x for x from LOWEST to 126, to 8e-8 of itself."""
    shifted = x + ROUND
    f = x - (shifted - ROUND)
    p = fma(P6, f, P5)
    p = fma(p, f, P4)
    p = fma(p, f, P3)
    p = fma(p, f, P2)
    p = fma(p, f, P1)
    p = fma(p, f, P0)
    return from_bits(to_bits(p) + (to_bits(shifted) << np.int32(23)))


@inline
def alpha_at(u, row_exponent, alpha_min, alpha_max):
    """Alpha of a pixel, 0 below alpha_min: 2^(row_exponent - u^2)."""
    exponent = max(fma(-u, u, row_exponent), LOWEST)
    alpha = min(exp2(exponent), alpha_max)
    return alpha if alpha >= alpha_min else ZERO
