"""The lists of tiles (cpu), over splats that end where tiles begin: every pair once, no tile too
many, none too few."""

from importlib import import_module

import numpy as np
import pytest
import torch
from tangents import tangent_scene

from asysplat.rendering import render
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.splat import TILE, Frame, ProjectSettings, load_ellipse
from asysplat.rendering.cpu.tiles import compute_box, list_tiles, scatter_pairs
from asysplat.rendering.formulas import PIXEL_MARGIN
from asysplat.rendering.interface import without_culling

SLACK = 1e-6  # pixels, of the margins themselves


@pytest.fixture
def lists_of(monkeypatch):
    """Renders with the cpu backend and returns what it listed."""
    module = import_module("asysplat.rendering.cpu.draw")
    list_tiles, kept = module._list_tiles, []

    def keep(*args):
        kept.append(list_tiles(*args))
        return kept[-1]

    monkeypatch.setattr(module, "_list_tiles", keep)

    def run(gaussians, cameras, **options):
        with torch.no_grad():
            render(gaussians, cameras, backend="cpu", depth=False, **options)
        return kept.pop()

    return run


class Ellipses:
    """Splats [n, 16] as float64: f(dx, dy) = (a dx + b dy)^2 + (c dy)^2 <= limit."""

    def __init__(self, splats: np.ndarray):
        base = splats.view(np.int32)[:, [col.BASE_X, col.BASE_Y]]
        self.x, self.y = (base + splats[:, [col.X, col.Y]].astype(np.float64)).T
        s = splats.astype(np.float64).T
        self.a, self.b, self.c = s[col.A] + s[col.A_REST], s[col.B] + s[col.B_REST], s[col.C]
        self.limit = (self.c * s[col.EXTENT_Y]) ** 2
        self.extent_x = s[col.EXTENT_Y] * np.hypot(self.b, self.c) / self.a
        self.extent_y = s[col.EXTENT_Y]

    def at(self, dx, dy):
        return (self.a * dx + self.b * dy) ** 2 + (self.c * dy) ** 2

    def least_over(self, left, right, top, bottom):
        """The least f over rectangles that are given from the image's corner."""
        left, right = left - self.x, right - self.x
        top, bottom = top - self.y, bottom - self.y
        least = np.full(len(self.x), np.inf)
        for dy in (top, bottom):
            least = np.minimum(least, self.at(np.clip(-self.b * dy / self.a, left, right), dy))
        for dx in (left, right):
            dy = np.clip(-self.a * self.b * dx / (self.b**2 + self.c**2), top, bottom)
            least = np.minimum(least, self.at(dx, dy))
        inside = (left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0)
        return np.where(inside, 0, least)


def check_lists(lists, height: int, width: int) -> int:
    """Assert all that is promised of them; the number of pairs."""
    rows, columns = -(-height // TILE), -(-width // TILE)
    pairs, tiles = len(lists.entries), rows * columns
    assert lists.first_pair[-1] == lists.first_entry[-1] == pairs
    assert (np.diff(lists.first_entry) >= 0).all()
    owner, number = lists.entries.T
    # Each pair once, and each with its splat.
    assert (np.bincount(number, minlength=pairs) == 1).all()
    assert (lists.first_pair[owner] <= number).all() and (
        number < lists.first_pair[owner + 1]
    ).all()
    # No tile twice, and none of another image.
    tile = np.repeat(np.arange(len(lists.first_entry) - 1), np.diff(lists.first_entry))
    num = (len(lists.first_pair) - 1) // ((len(lists.first_entry) - 1) // tiles)
    assert (tile // tiles == owner // num).all()
    assert len(np.unique(owner.astype(np.int64) * len(lists.first_entry) + tile)) == pairs

    # Each tile has something of its splat between its outermost pixel centers.
    ellipses = Ellipses(lists.splats[owner])
    left, top = tile % tiles % columns * TILE + 0.5, tile % tiles // columns * TILE + 0.5
    right = np.minimum(left + TILE - 1, width - 0.5)
    bottom = np.minimum(top + TILE - 1, height - 0.5)
    room = PIXEL_MARGIN + SLACK
    assert (np.abs((left + right) / 2 - ellipses.x) <= ellipses.extent_x + TILE / 2 + room).all()
    assert (np.abs((top + bottom) / 2 - ellipses.y) <= ellipses.extent_y + TILE / 2 + room).all()
    least = ellipses.least_over(left - room, right + room, top - room, bottom + room)
    # A box of one row or column is listed whole.
    row, column = tile % tiles // columns, tile % tiles % columns
    several = np.ones(len(lists.splats), bool)
    for index in (row, column):
        lowest, highest = np.full(len(several), tiles), np.zeros(len(several), int)
        np.minimum.at(lowest, owner, index)
        np.maximum.at(highest, owner, index)
        several &= highest > lowest
    assert several.any()
    assert (least <= ellipses.limit * (1 + 1e-6))[several[owner]].all()

    # Each pixel that shows a splat is in one of its tiles.
    listed = np.zeros((len(lists.splats), tiles), bool)
    listed[owner, tile % tiles] = True
    some = np.flatnonzero(np.diff(lists.first_pair))[::41]
    shown = Ellipses(lists.splats[some])
    opacity = lists.splats[some, col.LOG_OPACITY].astype(np.float64)
    for y in range(height):
        dx = np.arange(width) + 0.5 - shown.x[:, None]
        dy = (y + 0.5 - shown.y)[:, None]
        power = (shown.a[:, None] * dx + shown.b[:, None] * dy) ** 2 + (shown.c[:, None] * dy) ** 2
        at, x = np.nonzero(opacity[:, None] - power >= np.log2(1 / 255))
        assert listed[some[at], y // TILE * columns + x // TILE].all()
    return pairs


@pytest.mark.parametrize("count", [2**14, pytest.param(2**17, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [(256, 256), (250, 256), (64, 300), (256, 17)], ids=str)
def test_splats_that_end_where_tiles_begin(lists_of, size, count):
    gaussians, cameras = tangent_scene(count, *size)
    assert check_lists(lists_of(gaussians, cameras), *size) > count
    views = cameras.map(lambda t: t.repeat(2, 1, 1))
    views.intrinsics[1, 0, 2] += 7.3
    exact = lists_of(gaussians, views)
    check_lists(exact, *size)
    with without_culling("ellipse"):
        boxes = lists_of(gaussians, views)
    assert len(boxes.entries) > len(exact.entries)
    assert (np.bincount(boxes.entries[:, 1]) == 1).all()


@pytest.mark.medium
def test_a_splat_whose_rows_end_past_its_box():
    """The box ends where a tile does: rounding put one row past it while another row fell short,
    and tiles that were listed were not those that had been counted."""
    splats = np.zeros((1, col.SPLAT), np.float32)
    bases = splats.view(np.int32)
    bases[0, [col.BASE_X, col.BASE_Y]] = 39, 41
    splats[0, [col.X, col.Y]] = 0.31234, 0.40988
    splats[0, [col.A, col.B, col.C]] = 0.29677019, -0.024766434, 0.29569972
    splats[0, [col.A_REST, col.B_REST]] = 1.3566894e-08, -4.2892007e-10
    splats[0, [col.LOG_OPACITY, col.EXTENT_Y]] = -0.61427963, 9.1877527
    any_settings = dict.fromkeys(ProjectSettings._fields, 0.0) | {"cull_ellipse": True}
    sizes = dict.fromkeys(Frame._fields, 1) | {"height": 256, "width": 256, "columns": 16}
    frame = Frame(**sizes | {"project": ProjectSettings(**any_settings)})
    ellipse, box = load_ellipse(splats, bases, 0), np.zeros(4, np.int32)
    extent_x = Ellipses(splats).extent_x[0]
    for nudge in (-2e-6, -1e-6, -1e-7, 0, 1e-7, 1e-6, 2e-6):
        room = compute_box(ellipse, extent_x * (1 + nudge), frame, box)
        histogram, tiles = np.zeros(256, np.int32), np.full(room, -1, np.int32)
        count = list_tiles(ellipse, box, frame, histogram, tiles, 0)
        assert sorted(set(tiles[:count]) - {35}) == [33, 34, 50]
        assert (tiles[count:] == -1).all()
        assert (np.flatnonzero(histogram) == np.sort(tiles[:count])).all()
        starts = (np.cumsum(histogram) - histogram).astype(np.int64).reshape(1, 1, -1)
        entries = np.full((count, 2), -1, np.int32)
        scatter_pairs(0, 1, tiles[:count], np.array([0, count]), starts, frame, entries)
        assert (entries[:, 0] == 0).all()
        assert (np.sort(entries[:, 1]) == np.arange(count)).all()
