"""Products of small matrices inside kernels, against NumPy's in float64."""

import numpy as np
import pytest

from asysplat.ops.simd.products import ROWS, add_product, add_triangle, transpose
from asysplat.ops.simd.threads import kernel
from asysplat.ops.simd.vectors import LANES

SIDE = 4 * ROWS


@kernel
def product(out, a, b, keep):
    add_product(out, a, b, keep)


@kernel
def triangle(out, a, b, upper):
    add_triangle(out, a, b, upper)


@kernel
def transposed(matrix, out):
    transpose(matrix, out)


def draw(*shape):
    return np.random.default_rng(0).standard_normal(shape).astype(np.float32)


def assert_close(found, expected):
    assert np.abs(found - expected).max() <= 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("rows", [1, ROWS, 2 * ROWS + 3])
@pytest.mark.parametrize("terms", [1, 64, 70])
@pytest.mark.parametrize("columns", [LANES, 3 * LANES])
def test_product(rows, terms, columns):
    out, a, b = draw(rows, columns), draw(rows, terms), draw(terms, columns)
    expected = 0.5 * out.astype(float) + a.astype(float) @ b
    product(out, a, b, np.float32(0.5))
    assert_close(out, expected)


def test_product_takes_a_transpose():
    a, b = draw(70, 2 * ROWS + 1), draw(70, LANES)
    out = np.zeros((a.shape[1], LANES), np.float32)
    product(out, a.T, b, np.float32(1))
    assert_close(out, a.T.astype(float) @ b)


def test_a_factor_of_zero_overwrites_nan():
    a, b = draw(ROWS + 1, 5), draw(5, LANES)
    out = np.full((ROWS + 1, LANES), np.nan, np.float32)
    product(out, a, b, np.float32(0))
    assert_close(out, a.astype(float) @ b)


@pytest.mark.parametrize("upper", [False, True])
def test_triangle(upper):
    a, b, out = draw(SIDE, SIDE), draw(SIDE, LANES), draw(SIDE, LANES)
    a = np.triu(a) if upper else np.tril(a)
    expected = out + a.astype(float) @ b
    triangle(out, a, b, upper)
    assert_close(out, expected)


@pytest.mark.parametrize("upper", [False, True])
def test_triangle_reads_no_zero_outside_the_diagonal_tiles(upper):
    blocks = np.arange(SIDE) // ROWS
    beside = blocks[:, None] > blocks if upper else blocks[:, None] < blocks
    a, b, out = draw(SIDE, SIDE), draw(SIDE, LANES), np.zeros((SIDE, LANES), np.float32)
    expected = np.where(beside, 0, a.astype(float)) @ b
    triangle(out, np.where(beside, np.float32(np.nan), a), b, upper)
    assert_close(out, expected)


@pytest.mark.parametrize("rows", [1, LANES, 2 * LANES + 5])
def test_transpose(rows):
    matrix = draw(rows, 2 * LANES)
    out = np.zeros((2 * LANES, 3 * LANES), np.float32)
    transposed(matrix, out)
    assert (out[:, :rows] == matrix.T).all()
    assert (out[:, rows:] == 0).all()
