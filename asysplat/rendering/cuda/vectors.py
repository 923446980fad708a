"""Three numbers as a tuple, and quaternions."""

import inspect
from collections.abc import Callable
from types import FunctionType

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering import formulas


def shared(formula: Callable) -> Callable:
    """Compiled; Triton wants to see its language among the names that a function knows."""
    bare = inspect.unwrap(formula)
    return kernel(FunctionType(bare.__code__, {"__name__": __name__, "tl": tl}))


dot = shared(formulas.dot)
cross = shared(formulas.cross)
scaled = shared(formulas.scaled)
plus = shared(formulas.plus)
times = shared(formulas.times)
rotation_columns = shared(formulas.rotation_columns)
rotation_gradient = shared(formulas.rotation_gradient)


@kernel
def load1(array, index, there):
    """Float64 from an array, 1 where it is not there."""
    return tl.load(array + index, mask=there, other=1.0).to(tl.float64)


@kernel
def load3(array, row, there):
    """Rows of three."""
    return (
        load1(array, 3 * row, there),
        load1(array, 3 * row + 1, there),
        load1(array, 3 * row + 2, there),
    )


@kernel
def load_row3(array, start):
    """Three numbers, the same for all."""
    return (tl.load(array + start), tl.load(array + start + 1), tl.load(array + start + 2))


@kernel
def store3(array, row, values, there):
    """Rows of three."""
    tl.store(array + 3 * row, values[0], mask=there)
    tl.store(array + 3 * row + 1, values[1], mask=there)
    tl.store(array + 3 * row + 2, values[2], mask=there)


@kernel
def load_unit_quaternion(quats, row, there):
    """Its four numbers, and 1 / its length."""
    w = load1(quats, 4 * row, there)
    x = load1(quats, 4 * row + 1, there)
    y = load1(quats, 4 * row + 2, there)
    z = load1(quats, 4 * row + 3, there)
    inverse = 1 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse
