"""Vectors of sixteen float32, each one Numba value, which a loop keeps in a register.

Wherever a vector is expected, a float32 is converted to sixteen equal numbers.
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

from asysplat.kernels.simd.threads import inline

LANES = 16  # numbers of a vector: one register of AVX-512, two of AVX2, four of SSE
HAS_FMA = bool(llvmlite.binding.get_host_cpu_features().get("fma", True))
FLOATS, INTEGERS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(ir.IntType(32), LANES)

ZEROS = ir.Constant(FLOATS, [0.0] * LANES)

ZERO, ONE = np.float32(0), np.float32(1)
# Adding and subtracting ROUND rounds a float32 to an integer, which is in the sum's lowest bits.
ROUND = np.float32(1.5 * 2**23)
UNDERFLOW = np.float32(-127)  # number whose `exp2` is exactly 0
# Coefficients of 2^f on [-1/2, 1/2]: Chebyshev interpolation, relative error 2e-9.
P0, P1, P2 = map(np.float32, (1.00000000059202, 0.6931472056005139, 0.24022646608715542))
P3, P4 = map(np.float32, (0.05550328997510684, 0.009618519534332742))
P5, P6 = map(np.float32, (0.00133998603653958, 0.00015337576817951937))


class Vector(types.Type):
    def __init__(self):
        super().__init__(name="Vector")

    def can_convert_from(self, typing_context, other):
        return Conversion.promote if other == types.float32 else None


VECTOR = Vector()
MASK = types.uint16  # a bit for each number of a vector


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, FLOATS)


def broadcast(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Return a vector of equal numbers."""
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(undefined, value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))


@lower_cast(types.Float, Vector)
def _cast(context, builder, from_type, to_type, value):
    return broadcast(builder, value)


def call_llvm(builder: ir.IRBuilder, result: ir.Type, name: str, *args: ir.Value, **options):
    """Call an LLVM intrinsic such as llvm.sqrt.v16f32."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, args, **options)


def emit_fma(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    """Return a * b + c of vectors or float32, rounded once if the processor supports it."""
    if not HAS_FMA:
        return builder.fadd(builder.fmul(a, b), c)
    if a.type != FLOATS:
        return builder.fma(a, b, c)
    return call_llvm(builder, FLOATS, f"llvm.fma.v{LANES}f32", a, b, c)


def check_range(context, builder, first, count, length) -> None:
    """With NUMBA_BOUNDSCHECK=1, check that `count` elements from `first` on are within `length`."""
    if not numba.config.BOUNDSCHECK:
        return
    with builder.if_then(builder.icmp_signed(">", count, count.type(0))):
        last = builder.add(first, builder.sub(count, count.type(1)))
        for index in (first, last):
            cgutils.do_boundscheck(context, builder, index, length)


@intrinsic
def fma(typing_context, a, b, c):
    """Return a * b + c of vectors or float32, rounded once if the processor supports it."""
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
    """Load `count` numbers of a contiguous array from `first` on; the others up to LANES are 0."""

    def generate(context, builder, signature, args):
        pointer, mask = _pointer_and_mask(context, builder, signature, args)
        name = f"llvm.masked.load.v{LANES}f32.p0"
        return call_llvm(builder, FLOATS, name, pointer, ir.IntType(32)(4), mask, ZEROS)

    return VECTOR(numbers, first, count), generate


@intrinsic
def store_some(typing_context, numbers, first, count, value):
    """Write the first `count` of a vector's numbers to a contiguous array, from `first` on."""

    def generate(context, builder, signature, args):
        pointer, mask = _pointer_and_mask(context, builder, signature, args)
        name = f"llvm.masked.store.v{LANES}f32.p0"
        call_llvm(builder, ir.VoidType(), name, args[3], pointer, ir.IntType(32)(4), mask)
        return context.get_dummy_value()

    return types.void(numbers, first, count, VECTOR), generate


@intrinsic
def zeros(typing_context):
    """Return a vector of zeros."""

    def generate(context, builder, signature, args):
        return ZEROS

    return VECTOR(), generate


def _unary(result: types.Type, emit: Callable[[ir.IRBuilder, ir.Value], ir.Value]):
    """Return an intrinsic that computes `emit` of a vector."""

    @intrinsic
    def compute(typing_context, value):
        def generate(context, builder, signature, args):
            return emit(builder, args[0])

        return result(VECTOR), generate

    return compute


def emit_sum(builder: ir.IRBuilder, vector: ir.Value) -> ir.Value:
    """Return the sum of a vector's numbers."""
    start, name = ir.FloatType()(-0.0), f"llvm.vector.reduce.fadd.v{LANES}f32"
    # "reassoc" lets the compiler add in the order that is fastest on the processor.
    return call_llvm(builder, ir.FloatType(), name, start, vector, fastmath=("reassoc",))


def _emit_sqrt(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    return call_llvm(builder, FLOATS, f"llvm.sqrt.v{LANES}f32", value)


def _emit_rsqrt(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    root = _emit_sqrt(builder, value)
    # "arcp" lets the compiler refine the processor's estimate, in a third of the time.
    return builder.fdiv(ir.Constant(FLOATS, [1.0] * LANES), root, flags=("arcp",))


def _emit_least(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    count = LANES
    while count > 1:
        count //= 2
        halves = [
            builder.shuffle_vector(value, value, lanes(first, first + count))
            for first in (0, count)
        ]
        value = builder.select(builder.fcmp_ordered("<", *halves), *halves)
    return builder.extract_element(value, ir.IntType(32)(0))


total = _unary(types.float32, emit_sum)  # sum of a vector's numbers
least = _unary(types.float32, _emit_least)  # least of a vector's numbers
sqrt = _unary(VECTOR, _emit_sqrt)  # square root of each number
rsqrt = _unary(VECTOR, _emit_rsqrt)  # 1 / sqrt(x) of each number, to a relative error of 3e-7


def vector_at(context, builder, signature, args, step=LANES):
    """Return a pointer to LANES elements of the array args[0], from args[1] x `step` on."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    index = context.cast(builder, args[1], signature.args[1], types.intp)
    first = builder.mul(index, index.type(step))
    check_range(context, builder, first, first.type(LANES), array.nitems)
    return builder.bitcast(builder.gep(array.data, [first]), FLOATS.as_pointer())


def _pointer_and_mask(context, builder, signature, args):
    """Return a pointer to element args[1] of args[0], and a mask of the first args[2] lanes."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    first = context.cast(builder, args[1], signature.args[1], types.intp)
    count = context.cast(builder, args[2], signature.args[2], types.intp)
    check_range(context, builder, first, count, array.nitems)
    pointer = builder.bitcast(builder.gep(array.data, [first]), FLOATS.as_pointer())
    count = builder.trunc(count, ir.IntType(32))
    return pointer, builder.icmp_signed("<", lanes(0, LANES), broadcast(builder, count))


def _binary(result: types.Type, emit: Callable[..., ir.Value]):
    """Return an intrinsic that computes `emit` of two vectors."""

    @intrinsic
    def compute(typing_context, a, b):
        def generate(context, builder, signature, args):
            return emit(builder, *args)

        return result(VECTOR, VECTOR), generate

    return compute


def _overload(symbol: Callable, emit: Callable[..., ir.Value]) -> None:
    """Overload an operator or function of two numbers for vectors, computed by `emit`."""
    compute = _binary(VECTOR, emit)

    @overload(symbol)
    def _(a, b):
        if VECTOR in (a, b):
            return lambda a, b: compute(a, b)


_overload(operator.add, lambda builder, a, b: builder.fadd(a, b))
_overload(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_overload(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_overload(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
# Both return the second number where either is NaN.
_overload(max, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_overload(min, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))


def _emit_less(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.bitcast(builder.fcmp_ordered("<", a, b), ir.IntType(LANES))


less = _binary(MASK, _emit_less)  # mask of the numbers with a < b; the first's bit is the lowest


@intrinsic
def where(typing_context, mask, yes, no):
    """Return the numbers of `yes` where the bit of `mask` is 1, and those of `no` elsewhere."""

    def generate(context, builder, signature, args):
        bits = builder.bitcast(args[0], ir.VectorType(ir.IntType(1), LANES))
        return builder.select(bits, *args[1:])

    return VECTOR(MASK, VECTOR, VECTOR), generate


def lanes(start: int, stop: int, step: int = 1) -> ir.Constant:
    """Return the vector of the integers from `start` to `stop`, such as the mask of a shuffle."""
    numbers = list(range(start, stop, step))
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), numbers)


@intrinsic
def add_to_exponent(typing_context, value, number):
    """Compute value * 2^n, where n is in the lowest bits of `number`."""

    def generate(context, builder, signature, args):
        bits = INTEGERS if value == VECTOR else ir.IntType(32)
        value_bits, number_bits = (builder.bitcast(arg, bits) for arg in args)
        shift = ir.Constant(bits, [23] * LANES if value == VECTOR else 23)
        total = builder.add(value_bits, builder.shl(number_bits, shift))
        return builder.bitcast(total, args[0].type)

    return value(value, value), generate


@inline
def exp2(x):
    """Compute 2^x for x from -126 to 126, to a relative error of 8e-8."""
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
    """Compute 2^x for x <= 0, to a relative error of 8e-8 or an absolute one of 1e-38."""
    return exp2(max(x, UNDERFLOW))
