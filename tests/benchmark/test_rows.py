"""The hot rows do what the kernels do whose floor they are."""

import numpy as np
import pytest

from asysplat.benchmark.render import rows, stages
from asysplat.ops.cpu.lanes import LANES
from asysplat.rendering import INRIA
from asysplat.rendering.cpu import backward, forward
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.backward import rasterize_backward
from asysplat.rendering.cpu.forward import rasterize
from asysplat.rendering.cpu.tile import PIXELS

LIMITS = (INRIA.alpha_min, INRIA.alpha_max, INRIA.transmittance_min)
CUTOFFS = tuple(map(np.float32, LIMITS))
TIMES = 40
GRID = (1, 1, col.TILE, col.TILE)


@pytest.fixture
def tile():
    """One tile's splat, tilted and bright, `TIMES` times, drawn by `rasterize`."""
    splat = stages.middle_splat(opacity=0.3)
    splat[col.B] = 0.2
    splat[[col.RED, col.GREEN, col.BLUE]] = 0.2, 0.5, 0.9
    splat[[col.X, col.Y]] = 7.7, 8.1
    splat[col.REACH_Y] = 100
    offset = 8 - float(splat[col.X]), 0.5 - float(splat[col.Y])
    first_entry, last_entry = np.array([0, TIMES]), np.empty(1, np.int64)
    numbers = np.arange(TIMES, dtype=np.int32)
    entries = np.stack((numbers, numbers), -1)
    splats = np.tile(splat, (TIMES, 1))
    lists = splats, first_entry, last_entry, entries
    image = np.empty((1, 3, col.TILE, col.TILE), np.float32)
    alpha, transmittance, stops = np.empty((3, 1, col.TILE, col.TILE), np.float32)
    counters = np.empty((1, col.COUNTERS), np.int64)
    options = np.ones(1, np.bool_), GRID, CUTOFFS, (False, False)
    layers = image, alpha, transmittance, None, None, stops, None, None
    rasterize(0, 1, *lists, *options, *layers, counters)
    assert counters[0, col.ROWS] == TIMES * col.TILE
    return splat, offset, lists, image, transmittance, stops


def planes(state, *starts):
    return np.stack([state[0, start : start + PIXELS].reshape(col.TILE, LANES) for start in starts])


def test_forward_rows_draw_what_rasterize_draws(tile):
    splat, offset, _, image, transmittance, _ = tile
    state = np.zeros((1, rows.FORWARD_STATE), np.float32)
    state[:, :PIXELS] = 1
    rows.forward_rows(0, 1, splat, offset, TIMES, CUTOFFS, state)
    assert 0 < transmittance.min() < 0.1
    np.testing.assert_array_equal(planes(state, 0) + planes(state, forward.REST), transmittance)
    np.testing.assert_array_equal(planes(state, forward.RED, forward.GREEN, forward.BLUE), image[0])


def test_backward_rows_sum_what_rasterize_backward_sums(tile):
    splat, offset, lists, image, transmittance, stops = tile
    grads = np.empty((TIMES, col.GRADIENT), np.float32)
    grad_image = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    grad_left = np.random.default_rng(1).normal(size=transmittance.shape).astype(np.float32)
    given = transmittance, stops, None, None, grad_image, grad_left, None, None
    rasterize_backward(0, 1, *lists, GRID, CUTOFFS, (False, False), *given, grads)

    state = np.zeros((1, rows.BACKWARD_STATE), np.float32)
    behind = transmittance[0] * grad_left[0]
    values = (transmittance[0], behind, stops[0], *grad_image[0])
    starts = (0, backward.BEHIND, backward.STOP, backward.G_RED, backward.G_GREEN, backward.G_BLUE)
    for start, plane in zip(starts, values, strict=True):
        state[0, start : start + PIXELS] = plane.reshape(-1)
    rows.backward_rows(0, 1, splat, offset, TIMES, CUTOFFS, state)

    def total(start):
        return state[0, start : start + LANES].sum()

    a, b, c = (float(splat[k]) for k in (col.A, col.B, col.C))
    eu, ey = total(backward.EU), total(backward.EY)
    x = offset[0] + np.arange(LANES) - (LANES - 1) / 2
    expected = {
        col.G_X: 2 * a * eu,
        col.G_Y: 2 * b * eu + 2 * c * c * ey,
        col.G_A: -2 * (state[0, backward.EU : backward.EU + LANES] * x).sum(),
        col.G_B: -2 * total(backward.EUY),
        col.G_C: -2 * c * total(backward.EYY),
        col.G_LOG_OPACITY: total(backward.E),
        col.G_RED: total(backward.RED),
        col.G_GREEN: total(backward.GREEN),
        col.G_BLUE: total(backward.BLUE),
    }
    scale = np.abs(grads).sum(0)
    for column, value in expected.items():
        assert abs(grads[:, column].sum() - value) < 1e-5 * scale[column], column
