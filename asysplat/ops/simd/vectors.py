"""Sixteen float32 as one value of Numba's, which a loop keeps in a register.

A float32 stands for sixteen equal ones wherever a vector is asked for.
"""

import operator
from collections.abc import Callable

import llvmlite.binding
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typeconv import Conversion
from numba.extending import intrinsic, lower_cast, overload, register_model

from asysplat.ops.simd.kernel import inline

LANES = 16  # one vector of AVX-512; two or four of older ones
HAS_FMA = bool(llvmlite.binding.get_host_cpu_features().get("fma", True))
FLOATS, INTEGERS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(ir.IntType(32), LANES)

ZERO, ONE = np.float32(0), np.float32(1)
# Added and taken away again, it rounds a float32 to an integer that stands in its lowest bits.
ROUND = np.float32(1.5 * 2**23)
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


class Vector(types.Type):
    def __init__(self):
        super().__init__(name="Vector")

    def can_convert_from(self, typing_context, other):
        return Conversion.promote if other == types.float32 else None


VECTOR = Vector()
MASK = types.uint16  # a bit for each of a vector's numbers


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, FLOATS)


def splat(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Return a vector of equal numbers."""
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(undefined, value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))


@lower_cast(types.Float, Vector)
def _splat(context, builder, from_type, to_type, value):
    return splat(builder, value)


def emit_fma(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    """Return a * b + c of vectors or float32, rounded once where the processor can do that."""
    if not HAS_FMA:
        return builder.fadd(builder.fmul(a, b), c)
    if a.type != FLOATS:
        return builder.fma(a, b, c)
    function = ir.FunctionType(FLOATS, [FLOATS] * 3)
    name = f"llvm.fma.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), [a, b, c])


def check_range(context, builder, first, count, length) -> None:
    """With NUMBA_BOUNDSCHECK=1, let the kernel raise IndexError for a range outside an array.

    It does unless `count` elements from `first` on are among `length`, as Numba does for one index.
    """
    if not numba.config.BOUNDSCHECK:
        return
    with builder.if_then(builder.icmp_signed(">", count, count.type(0))):
        last = builder.add(first, builder.sub(count, count.type(1)))
        for index in (first, last):
            cgutils.do_boundscheck(context, builder, index, length)


@intrinsic
def fma(typing_context, a, b, c):
    """Return a * b + c of vectors or float32, rounded once where the processor can do that."""
    kind = VECTOR if VECTOR in (a, b, c) else a

    def generate(context, builder, signature, args):
        return emit_fma(builder, *args)

    return kind(kind, kind, kind), generate


@intrinsic
def load(typing_context, rows, row):
    """Load row `row` of a contiguous array [rows, LANES]."""

    def generate(context, builder, signature, args):
        return builder.load(vector_at(context, builder, signature, args), align=4)

    return VECTOR(rows, row), generate


@intrinsic
def store(typing_context, rows, row, value):
    """Write row `row` of a contiguous array [rows, LANES]."""

    def generate(context, builder, signature, args):
        builder.store(args[2], vector_at(context, builder, signature, args), align=4)
        return context.get_dummy_value()

    return types.void(rows, row, VECTOR), generate


@intrinsic
def load_some(typing_context, numbers, first, count):
    """Load `count` numbers of a contiguous array from `first` on, and zeros up to LANES."""

    def generate(context, builder, signature, args):
        pointer, mask = _some(context, builder, signature, args)
        kind = ir.FunctionType(FLOATS, [pointer.type, ir.IntType(32), mask.type, FLOATS])
        name = f"llvm.masked.load.v{LANES}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        nothing = ir.Constant(FLOATS, [0.0] * LANES)
        return builder.call(function, [pointer, ir.IntType(32)(4), mask, nothing])

    return VECTOR(numbers, first, count), generate


@intrinsic
def store_some(typing_context, numbers, first, count, value):
    """Write the first `count` of a vector's numbers to a contiguous array, from `first` on."""

    def generate(context, builder, signature, args):
        pointer, mask = _some(context, builder, signature, args)
        kind = ir.FunctionType(ir.VoidType(), [FLOATS, pointer.type, ir.IntType(32), mask.type])
        name = f"llvm.masked.store.v{LANES}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(function, [args[3], pointer, ir.IntType(32)(4), mask])
        return context.get_dummy_value()

    return types.void(numbers, first, count, VECTOR), generate


@intrinsic
def zeros(typing_context):
    """Return a vector of zeros."""

    def generate(context, builder, signature, args):
        return ir.Constant(FLOATS, [0.0] * LANES)

    return VECTOR(), generate


@intrinsic
def total(typing_context, value):
    """Return the sum of a vector's numbers."""

    def generate(context, builder, signature, args):
        return sum_of(builder, args[0])

    return types.float32(VECTOR), generate


def sum_of(builder: ir.IRBuilder, vector: ir.Value) -> ir.Value:
    """Return the sum of a vector's numbers."""
    kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), FLOATS])
    name = f"llvm.vector.reduce.fadd.v{LANES}f32"
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    # "reassoc" frees the compiler to add in the order that is fastest on the processor.
    return builder.call(function, [ir.FloatType()(-0.0), vector], fastmath=("reassoc",))


def vector_at(context, builder, signature, args, step=LANES):
    """Return a pointer to LANES elements of the contiguous array args[0].

    They begin at the element args[1] x `step`.
    """
    array = context.make_array(signature.args[0])(context, builder, args[0])
    index = context.cast(builder, args[1], signature.args[1], types.intp)
    first = builder.mul(index, index.type(step))
    check_range(context, builder, first, first.type(LANES), array.nitems)
    return builder.bitcast(builder.gep(array.data, [first]), FLOATS.as_pointer())


def _some(context, builder, signature, args):
    """Return a pointer to element args[1] of args[0], and a mask of the first args[2] lanes."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    first = context.cast(builder, args[1], signature.args[1], types.intp)
    count = context.cast(builder, args[2], signature.args[2], types.intp)
    check_range(context, builder, first, count, array.nitems)
    pointer = builder.bitcast(builder.gep(array.data, [first]), FLOATS.as_pointer())
    few = builder.trunc(count, ir.IntType(32))
    return pointer, builder.icmp_signed("<", lanes(0, LANES), splat(builder, few))


def _arithmetic(symbol: Callable, instruction: str) -> None:
    """Overload `symbol` for vectors."""

    @intrinsic
    def compute(typing_context, a, b):
        def generate(context, builder, signature, args):
            return getattr(builder, instruction)(*args)

        return VECTOR(VECTOR, VECTOR), generate

    @overload(symbol)
    def _(a, b):
        if VECTOR in (a, b):
            return lambda a, b: compute(a, b)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


def _extremum(symbol: Callable, comparison: str) -> None:
    """Overload `symbol`, max or min, for vectors: the second number where the first is NaN."""

    @intrinsic
    def choose(typing_context, a, b):
        def generate(context, builder, signature, args):
            return builder.select(builder.fcmp_ordered(comparison, *args), *args)

        return VECTOR(VECTOR, VECTOR), generate

    @overload(symbol)
    def _(a, b):
        if VECTOR in (a, b):
            return lambda a, b: choose(a, b)


_extremum(max, ">")
_extremum(min, "<")


def emit_sqrt(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Emit the square root of every number of a vector."""
    kind, name = ir.FunctionType(FLOATS, [FLOATS]), f"llvm.sqrt.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [value])


@intrinsic
def sqrt(typing_context, value):
    """Compute the square root of every number of a vector."""

    def generate(context, builder, signature, args):
        return emit_sqrt(builder, args[0])

    return VECTOR(VECTOR), generate


@intrinsic
def rsqrt(typing_context, value):
    """Compute 1 / sqrt(x) of every number of a vector, to 3e-7 of itself."""

    def generate(context, builder, signature, args):
        root = emit_sqrt(builder, args[0])
        # "arcp" lets the compiler refine the processor's estimate, in a third of the time.
        return builder.fdiv(ir.Constant(FLOATS, [1.0] * LANES), root, flags=("arcp",))

    return VECTOR(VECTOR), generate


@intrinsic
def less(typing_context, a, b):
    """Return a bit for each number of two vectors, the lowest for the first: 1 if a < b."""

    def generate(context, builder, signature, args):
        return builder.bitcast(builder.fcmp_ordered("<", *args), ir.IntType(LANES))

    return MASK(VECTOR, VECTOR), generate


@intrinsic
def where(typing_context, mask, yes, no):
    """Return the numbers of `yes` whose bit of `mask` is 1, and those of `no` elsewhere."""

    def generate(context, builder, signature, args):
        bits = builder.bitcast(args[0], ir.VectorType(ir.IntType(1), LANES))
        return builder.select(bits, *args[1:])

    return VECTOR(MASK, VECTOR, VECTOR), generate


@intrinsic
def least(typing_context, value):
    """Return the least of a vector's numbers."""

    def generate(context, builder, signature, args):
        (rest,) = args
        count = LANES
        while count > 1:
            count //= 2
            halves = [
                builder.shuffle_vector(rest, rest, lanes(first, first + count))
                for first in (0, count)
            ]
            rest = builder.select(builder.fcmp_ordered("<", *halves), *halves)
        return builder.extract_element(rest, ir.IntType(32)(0))

    return types.float32(VECTOR), generate


def lanes(start: int, stop: int, step: int = 1) -> ir.Constant:
    """Return a vector of whole numbers, such as those that choose others."""
    numbers = list(range(start, stop, step))
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), numbers)


@intrinsic
def add_to_exponent(typing_context, value, number):
    """Compute value * 2^n, where n stands in the lowest bits of `number`."""

    def generate(context, builder, signature, args):
        bits = INTEGERS if value == VECTOR else ir.IntType(32)
        value_bits, number_bits = (builder.bitcast(arg, bits) for arg in args)
        shift = ir.Constant(bits, [23] * LANES if value == VECTOR else 23)
        total = builder.add(value_bits, builder.shl(number_bits, shift))
        return builder.bitcast(total, args[0].type)

    return value(value, value), generate


@inline
def exp2(x):
    """Compute 2^x for x from -126 to 126, to 8e-8 of itself."""
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
    """Compute 2^x for x <= 0, to 8e-8 of itself or 1e-38; 0 from UNDERFLOW on."""
    return exp2(max(x, UNDERFLOW))
