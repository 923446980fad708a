"""The hot rows do what the kernels do whose floor they are."""

import numpy as np
import pytest

from asysplat.benchmark.render import rows, stages
from asysplat.ops.cpu.vectors import LANES
from asysplat.rendering import INRIA
from asysplat.rendering.cpu import rasterize as raster
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.rasterize import (
    PIXELS,
    Gradients,
    Images,
    Saved,
    rasterize,
    rasterize_backward,
)
from asysplat.rendering.cpu.splat import Frame, ProjectSettings, RasterSettings
from asysplat.rendering.cpu.tiles import Lists

LIMITS = (INRIA.alpha_min, INRIA.alpha_max, INRIA.transmittance_min)
SETTINGS = RasterSettings(*map(np.float32, LIMITS), skip_rows=False, skip_opaque=False)
TIMES = 40
SIZES = dict.fromkeys(Frame._fields, 1) | {"height": col.TILE, "width": col.TILE}
UNUSED = ProjectSettings(**dict.fromkeys(ProjectSettings._fields, 0.0))
FRAME = Frame(**SIZES | {"project": UNUSED, "raster": SETTINGS})


@pytest.fixture
def tile():
    """One tile's splat, tilted and bright, `TIMES` times, drawn by `rasterize`."""
    splat = stages.middle_splat(opacity=0.3)
    splat[col.B] = 0.2
    splat[[col.RED, col.GREEN, col.BLUE]] = 0.2, 0.5, 0.9
    splat[[col.X, col.Y]] = 7.7, 8.1
    splat[col.EXTENT_Y] = 100
    offset = 8 - float(splat[col.X]), 0.5 - float(splat[col.Y])
    numbers = np.arange(TIMES, dtype=np.int32)
    lists = Lists(
        splats=np.tile(splat, (TIMES, 1)),
        first_pair=np.arange(TIMES + 1),
        first_entry=np.array([0, TIMES]),
        entries=np.stack((numbers, numbers), -1),
        wanted=np.ones(1, np.bool_),
    )
    alpha, transmittance, stops = np.empty((3, 1, col.TILE, col.TILE), np.float32)
    images = Images(np.empty((1, 3, col.TILE, col.TILE), np.float32), alpha)
    counters = np.empty((1, raster.COUNTERS), np.int64)
    saved = Saved(transmittance, stops, np.empty(1, np.int64), counters)
    rasterize(0, 1, lists, FRAME, images, saved, None, None)
    assert counters[0, raster.ROWS] == TIMES * col.TILE
    return splat, offset, lists, images.image, saved


def planes(state, *starts):
    return np.stack([state[0, start : start + PIXELS].reshape(col.TILE, LANES) for start in starts])


def test_forward_rows_draw_what_rasterize_draws(tile):
    splat, offset, _, image, (transmittance, *_) = tile
    state = np.zeros((1, rows.STATE), np.float32)
    state[:, :PIXELS] = 1
    rows.forward_rows(0, 1, splat, offset, TIMES, SETTINGS, state)
    assert 0 < transmittance.min() < 0.1
    np.testing.assert_array_equal(planes(state, 0) + planes(state, raster.REST), transmittance)
    np.testing.assert_array_equal(planes(state, raster.RED, raster.GREEN, raster.BLUE), image[0])


def test_backward_rows_sum_what_rasterize_backward_sums(tile):
    splat, offset, lists, image, saved = tile
    transmittance, stops = saved.transmittance, saved.stops
    grads = np.empty((TIMES, col.GRADIENT), np.float32)
    grad_image = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    grad_left = np.random.default_rng(1).normal(size=transmittance.shape).astype(np.float32)
    given = Gradients(grad_image, grad_left, grads)
    rasterize_backward(0, 1, lists, FRAME, saved, given, None, None)

    state = np.zeros((1, rows.BACKWARD_STATE), np.float32)
    behind = transmittance[0] * grad_left[0]
    values = (transmittance[0], behind, stops[0], *grad_image[0])
    starts = (0, raster.G_BEHIND, raster.G_STOP, raster.G_RED, raster.G_GREEN, raster.G_BLUE)
    for start, plane in zip(starts, values, strict=True):
        state[0, start : start + PIXELS] = plane.reshape(-1)
    rows.backward_rows(0, 1, splat, offset, TIMES, SETTINGS, state)

    def total(start):
        return state[0, start : start + LANES].sum()

    a, b, c = (float(splat[k]) for k in (col.A, col.B, col.C))
    eu, ey = total(raster.SUM_EU), total(raster.SUM_EY)
    x = offset[0] + np.arange(LANES) - (LANES - 1) / 2
    expected = {
        col.G_X: 2 * a * eu,
        col.G_Y: 2 * b * eu + 2 * c * c * ey,
        col.G_A: -2 * (state[0, raster.SUM_EU : raster.SUM_EU + LANES] * x).sum(),
        col.G_B: -2 * total(raster.SUM_EUY),
        col.G_C: -2 * c * total(raster.SUM_EYY),
        col.G_LOG_OPACITY: total(raster.SUM_E),
        col.G_RED: total(raster.SUM_RED),
        col.G_GREEN: total(raster.SUM_GREEN),
        col.G_BLUE: total(raster.SUM_BLUE),
    }
    scale = np.abs(grads).sum(0)
    for column, value in expected.items():
        assert abs(grads[:, column].sum() - value) < 1e-5 * scale[column], column
