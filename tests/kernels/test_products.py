"""Products of small matrices inside kernels, against NumPy's in float64."""

import numpy as np
import pytest

from asysplat.kernels.simd.products import ROWS, add_product, add_triangle, transpose
from asysplat.kernels.simd.threads import kernel
from asysplat.kernels.simd.vectors import LANES

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
@pytest.mark.parametrize("terms, columns", [(1, LANES), (64, 3 * LANES), (70, LANES)])
def test_product_adds_to_a_multiple_of_the_output(rows, terms, columns):
    out, a, b = draw(rows, columns), draw(rows, terms), draw(terms, columns)
    expected = 0.5 * out.astype(float) + a.astype(float) @ b
    product(out, a, b, np.float32(0.5))
    assert_close(out, expected)
    out = np.full((rows, columns), np.nan, np.float32)
    product(out, draw(terms, rows).T, b, np.float32(0))  # overwrites NaN; factors may be transposed
    assert_close(out, draw(terms, rows).T.astype(float) @ b)


@pytest.mark.parametrize("upper", [False, True])
def test_triangle_reads_no_zero_outside_the_diagonal_tiles(upper):
    a, b, out = draw(SIDE, SIDE), draw(SIDE, LANES), draw(SIDE, LANES)
    a = np.triu(a) if upper else np.tril(a)
    expected = out + a.astype(float) @ b
    blocks = np.arange(SIDE) // ROWS
    a[blocks[:, None] > blocks if upper else blocks[:, None] < blocks] = np.nan
    triangle(out, a, b, upper)
    assert_close(out, expected)


@pytest.mark.parametrize("rows", [1, LANES, 2 * LANES + 5])
def test_transposed_fills_the_rest_with_zeros(rows):
    matrix = draw(rows, 2 * LANES)
    out = np.zeros((2 * LANES, 3 * LANES), np.float32)
    transposed(matrix, out)
    assert (out[:, :rows] == matrix.T).all()
    assert (out[:, rows:] == 0).all()
