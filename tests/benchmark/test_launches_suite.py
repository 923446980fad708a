"""How often a rendering and a step of a refinement call a GPU, and wait for it."""

import pytest
import torch
from compiler import INTERPRETED
from rich.console import Console

pytest.importorskip("triton")
if INTERPRETED:
    pytest.skip("Triton interprets its kernels here", allow_module_level=True)

from asysplat.rendering import render
from benchmarks import launches

MOST = {  # launches and waits
    "render": (13, 1),  # the number of pairs, when a GPU has been given all its work
    "render, with a graph": (13, 1),
    "its gradient": (4, 0),
    "step of a refinement": (52, 1),
    "with known depths": (94, 1),
}
MOST_KILOBYTES = {  # of a token
    "m, Mamba2 both ways": 158,
    "s, sparse attention": 158,
    "MambaVision": 30,
    "fine to coarse": 115,
    "coarse to fine": 59,
}
MOST_MEGABYTES = {"100,000 Gaussians, 540x960": 53, "1 million, 1080x1920": 315}


def test_no_more_launches_waits_and_memory_than_today(make_options, monkeypatch):
    scenes = {name: launches.SCENES[name] for name in MOST_MEGABYTES}
    monkeypatch.setattr(launches, "SCENES", scenes)
    results = launches.measure(make_options("launches", {}), Console(quiet=True))
    found = {row["case"]: (row["launches"], row["waits"]) for row in results["rows"]}
    assert found.keys() == MOST.keys()
    for case, (most, waits) in MOST.items():
        assert found[case][0] <= most and found[case][1] <= waits, case
    for row, most in zip(results["memory"], MOST_MEGABYTES.values(), strict=True):
        assert 0 < row["kept"] < row["peak"] <= most * 1e6
    for row, (block, most) in zip(results["blocks"], MOST_KILOBYTES.items(), strict=True):
        assert row["block"] == block and 0 < row["bytes"] <= most * 1e3
    rows = [table.row_count for table in launches.tables(results)]
    assert rows == [len(MOST), len(MOST_MEGABYTES), len(MOST_KILOBYTES)]


def test_statistics_wait_when_they_are_read():
    with launches.as_on_a_gpu() as recorder:
        views, gaussians = launches.make_views(2), launches.make_gaussians(needed=False)
        with recorder.counting() as drawn:
            stats = render(gaussians, views.cameras, depth=False).stats
        with recorder.counting() as read:
            assert stats["tile_size"] == 8
            assert {*stats} >= {"visible", "pairs"} and len(stats) == 8
    assert drawn.waits == read.waits == 1


def test_what_is_counted():
    mask = torch.tensor([True, False])
    with launches.as_on_a_gpu() as recorder, recorder.counting() as counts:
        values = torch.ones(2)[None].squeeze(0)  # one launch
        values = values[mask]  # one, which waits
        values.sum().item()  # two, one waits
        torch.tensor([1.0], device="cpu")  # a copy, which waits
    assert (counts.operators, counts.waits, counts.kernels) == (5, 3, 0)
