"""Products of small matrices that are in the cache, for use inside kernels.

A tile of ROWS x LANES sums stays in registers, and every sum is taken in the order of its terms,
rounded once per term: the tiling changes no bit.
"""

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.extending import intrinsic

from asysplat.kernels.simd.threads import inline
from asysplat.kernels.simd.vectors import (
    FLOATS,
    INTEGERS,
    LANES,
    ONE,
    ZEROS,
    broadcast,
    check_range,
    emit_fma,
)

HAS_AVX512 = bool(llvmlite.binding.get_host_cpu_features().get("avx512f", False))
ROWS = 8 if HAS_AVX512 else 4  # rows of a tile: its sums take 8 registers of AVX-512 or of AVX2
BYTES = 4  # size of a float32


@inline
def add_product(out, a, b, keep):
    """Compute out = keep out + a b; with `keep` = 0, NaN in `out` is overwritten too.

    `out` and `b` are contiguous along rows, of a multiple of LANES numbers; `a` has any strides.
    """
    rows, terms = a.shape
    whole = rows // ROWS * ROWS
    for column in range(0, out.shape[1], LANES):
        for row in range(0, whole, ROWS):
            add_tile(out, a, b, row, column, 0, terms, keep)
        for row in range(whole, rows):
            add_row(out, a, b, row, column, 0, terms, keep)


@inline
def add_triangle(out, a, b, upper):
    """Compute out += a b, where square `a` has zeros below its diagonal (`upper`) or above it.

    The side of `a` is a multiple of ROWS. Its zeros are read only in the tiles on the diagonal.
    """
    side = len(a)
    for column in range(0, out.shape[1], LANES):
        for row in range(0, side, ROWS):
            first = row if upper else 0
            last = side if upper else row + ROWS
            add_tile(out, a, b, row, column, first, last, ONE)


@inline
def transpose(matrix, out):
    """Write the transpose of `matrix` into the first columns of `out`.

    Both are contiguous along rows; the columns of `matrix` are a multiple of LANES.
    """
    rows, columns = matrix.shape
    whole = rows // LANES * LANES
    for column in range(0, columns, LANES):
        for row in range(0, whole, LANES):
            transpose_tile(matrix, out, row, column)
        for row in range(whole, rows):
            for i in range(column, column + LANES):
                out[i, row] = matrix[row, i]


@intrinsic
def transpose_tile(typing_context, matrix, out, row, column):
    """Write the transpose of the LANES x LANES numbers of `matrix` from `row`, `column` on."""

    def generate(context, builder, signature, args):
        source, target = (_Matrix(context, builder, signature.args[i], args[i]) for i in range(2))
        row, column = (
            context.cast(builder, args[i], signature.args[i], types.intp) for i in (2, 3)
        )
        source.check(row, LANES, column, LANES)
        target.check(column, LANES, row, LANES)
        vectors = [
            builder.load(source.vector(builder.add(row, row.type(i)), column), align=BYTES)
            for i in range(LANES)
        ]
        # Interleaving the first half of the rows with the second, log2(LANES) times, transposes.
        half = LANES // 2
        for _ in range(LANES.bit_length() - 1):
            vectors = [
                _interleave(builder, vectors[i], vectors[i + half], first)
                for i in range(half)
                for first in (0, half)
            ]
        for i, vector in enumerate(vectors):
            place = target.vector(builder.add(column, column.type(i)), row)
            builder.store(vector, place, align=BYTES)
        return context.get_dummy_value()

    return types.void(matrix, out, row, column), generate


def _interleave(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, first: int) -> ir.Value:
    """Interleave the LANES / 2 numbers of each vector from the number `first` on."""
    order = [i for k in range(first, first + LANES // 2) for i in (k, LANES + k)]
    return builder.shuffle_vector(a, b, ir.Constant(INTEGERS, order))


def _make_tile_product(rows: int):
    """Return the intrinsic that computes out = keep out + a b for rows x LANES numbers of `out`.

    The numbers begin at `row` and `column`; the product sums the terms from `first` to `last`.
    """

    @intrinsic
    def add(typing_context, out, a, b, row, column, first, last, keep):
        def generate(context, builder, signature, args):
            matrices = [_Matrix(context, builder, signature.args[i], args[i]) for i in range(3)]
            indices = zip(args[3:7], signature.args[3:7], strict=True)
            indices = (context.cast(builder, value, kind, types.intp) for value, kind in indices)
            _generate_tile_product(builder, rows, matrices, *indices, args[7])
            return context.get_dummy_value()

        return types.void(out, a, b, row, column, first, last, keep), generate

    return add


def _generate_tile_product(builder, rows, matrices, row, column, first, last, keep):
    out, a, b = matrices
    terms = builder.sub(last, first)
    out.check(row, rows, column, LANES)
    a.check(row, rows, first, terms)
    b.check(first, terms, column, LANES)
    numbers = [builder.add(row, row.type(i)) for i in range(rows)]
    places = [out.vector(number, column) for number in numbers]
    # LLVM keeps such local variables in registers.
    sums = [cgutils.alloca_once(builder, FLOATS) for _ in range(rows)]
    overwrite = builder.fcmp_ordered("==", keep, keep.type(0.0))
    for place, value in zip(places, sums, strict=True):
        scaled = builder.fmul(builder.load(place, align=BYTES), broadcast(builder, keep))
        builder.store(builder.select(overwrite, ZEROS, scaled), value)
    with cgutils.for_range_slice(builder, first, last, first.type(1)) as (term, _):
        vector = builder.load(b.vector(term, column), align=BYTES)
        for number, value in zip(numbers, sums, strict=True):
            factor = broadcast(builder, builder.load(a.element(number, term), align=BYTES))
            builder.store(emit_fma(builder, factor, vector, builder.load(value)), value)
    for place, value in zip(places, sums, strict=True):
        builder.store(builder.load(value), place, align=BYTES)


class _Matrix:
    """A float32 array of any strides in generated code."""

    def __init__(self, context: BaseContext, builder: ir.IRBuilder, kind: types.Array, value):
        array = context.make_array(kind)(context, builder, value)
        self.context, self.builder = context, builder
        self.shape = [builder.extract_value(array.shape, axis) for axis in range(2)]
        self.data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
        self.strides = [builder.extract_value(array.strides, axis) for axis in range(2)]

    def check(self, row, rows, column, columns) -> None:
        """Check the ranges of rows and columns by `check_range`; counts may be generated values."""
        for first, count, length in zip((row, column), (rows, columns), self.shape, strict=True):
            count = first.type(count) if isinstance(count, int) else count
            check_range(self.context, self.builder, first, count, length)

    def element(self, row: ir.Value, column: ir.Value) -> ir.Value:
        """Return a pointer to an element."""
        offsets = map(self.builder.mul, (row, column), self.strides)
        byte = self.builder.gep(self.data, [self.builder.add(*offsets)])
        return self.builder.bitcast(byte, ir.FloatType().as_pointer())

    def vector(self, row: ir.Value, column: ir.Value) -> ir.Value:
        """Return a pointer to the LANES elements from this one on."""
        return self.builder.bitcast(self.element(row, column), FLOATS.as_pointer())


add_tile, add_row = _make_tile_product(ROWS), _make_tile_product(1)
