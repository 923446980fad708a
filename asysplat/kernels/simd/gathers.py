"""Gathers at sixteen points of an image at once; each read returns two adjacent numbers."""

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from asysplat.kernels.simd.vectors import (
    FLOATS,
    INTEGERS,
    LANES,
    VECTOR,
    broadcast,
    call_llvm,
    check_range,
    lanes,
)

HALF = LANES // 2
PAIR = ir.IntType(64)


@intrinsic
def gather_pairs(typing_context, image, y, x):
    """Return both numbers at LANES points y, x >= 0, rounded down, of a contiguous [H, W, 2]."""

    def generate(context, builder, signature, args):
        image = _Image(context, builder, signature, args)
        pairs = image.pairs(image.index(*image.round_down(args[1:])), PAIR)
        return context.make_tuple(builder, signature.return_type, pairs)

    return types.UniTuple(VECTOR, 2)(image, y, x), generate


@intrinsic
def gather_squares(typing_context, image, y, x):
    """Return the four numbers around LANES points of a contiguous array [H, W].

    The points have 0 <= y < H - 1 and 0 <= x < W - 1. Six vectors are returned: the numbers above
    left, above right, below left and below right; and the fractions of y and x, in [0, 1).
    """

    def generate(context, builder, signature, args):
        image = _Image(context, builder, signature, args)
        whole = image.round_down(args[1:])
        above = image.index(*whole)
        below = builder.add(above, image.width)
        numbers = [pair for row in (above, below) for pair in image.pairs(row, ir.FloatType())]
        fractions = [
            builder.fsub(coordinate, builder.sitofp(number, FLOATS))
            for coordinate, number in zip(args[1:], whole, strict=True)
        ]
        return context.make_tuple(builder, signature.return_type, numbers + fractions)

    return types.UniTuple(VECTOR, 6)(image, y, x), generate


class _Image:
    """A contiguous float32 array [H, W] or [H, W, 2] in generated code."""

    def __init__(self, context, builder, signature, args):
        self.context, self.builder = context, builder
        self.array = context.make_array(signature.args[0])(context, builder, args[0])
        width = builder.extract_value(self.array.shape, 1)
        self.width = broadcast(builder, builder.trunc(width, ir.IntType(32)))

    def round_down(self, coordinates):
        """Round coordinates >= 0 down to integers."""
        return [self.builder.fptosi(coordinate, INTEGERS) for coordinate in coordinates]

    def index(self, row: ir.Value, column: ir.Value) -> ir.Value:
        return self.builder.add(self.builder.mul(row, self.width), column)

    def pairs(self, index: ir.Value, kind: ir.Type) -> list[ir.Value]:
        """Return the numbers at LANES indices, and the numbers after them.

        Both are read as one number of 64 bits. Indices count numbers or, if `kind` is PAIR, pairs.
        """
        builder = self.builder
        self._check(index, kind)
        pointer = self.array.data
        pointers, bits = ir.VectorType(pointer.type, HALF), ir.VectorType(PAIR, HALF)
        all_lanes = ir.Constant(ir.VectorType(ir.IntType(1), HALF), [1] * HALF)
        name = f"llvm.masked.gather.v{HALF}i64.v{HALF}p0"
        first = builder.insert_element(
            ir.Constant(pointers, ir.Undefined), pointer, ir.IntType(32)(0)
        )
        base = builder.shuffle_vector(first, first, ir.Constant(lanes(0, HALF).type, [0] * HALF))
        halves = []
        for begin in (0, HALF):
            half = builder.shuffle_vector(index, index, lanes(begin, begin + HALF))
            places = builder.gep(base, [half], source_etype=kind)
            nothing = ir.Constant(bits, [0] * HALF)
            align = ir.IntType(32)(4)
            gathered = call_llvm(builder, bits, name, places, align, all_lanes, nothing)
            halves.append(builder.bitcast(gathered, FLOATS))
        return [builder.shuffle_vector(*halves, lanes(k, 2 * LANES, 2)) for k in (0, 1)]

    def _check(self, index: ir.Value, kind: ir.Type) -> None:
        """With NUMBA_BOUNDSCHECK=1, check that every pair is inside the array."""
        if not numba.config.BOUNDSCHECK:
            return
        step = 2 if kind == PAIR else 1
        for lane in range(LANES):
            first = self.builder.extract_element(index, ir.IntType(32)(lane))
            first = self.builder.sext(first, self.array.nitems.type)
            first = self.builder.mul(first, first.type(step))
            check_range(self.context, self.builder, first, first.type(2), self.array.nitems)
