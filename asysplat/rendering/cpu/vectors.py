"""Three numbers as a tuple, and quaternions."""

import math

from asysplat.ops.cpu.kernel import inline
from asysplat.rendering import formulas

dot = inline(formulas.dot)
cross = inline(formulas.cross)
scaled = inline(formulas.scaled)
plus = inline(formulas.plus)
times = inline(formulas.times)
rotation_columns = inline(formulas.rotation_columns)
rotation_gradient = inline(formulas.rotation_gradient)


@inline
def row3(array, row, column=0):
    """Three float64 from a row of an array."""
    return (float(array[row, column]), float(array[row, column + 1]), float(array[row, column + 2]))


@inline
def triple(array, start):
    """Three float64 from a flat array."""
    return (float(array[start]), float(array[start + 1]), float(array[start + 2]))


@inline
def unit_quaternion(quats, start):
    """Its four numbers, from a flat array, and 1 / its length."""
    w, x, y, z = (
        float(quats[start]),
        float(quats[start + 1]),
        float(quats[start + 2]),
        float(quats[start + 3]),
    )
    inverse = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse
