"""The suite systems on a small scene: complete rows, measured as the parts say."""

import pytest
import torch
from rich.console import Console

from asysplat.errors import InputError
from asysplat.refinement import refine
from asysplat.refinement.init import initial_gaussians
from asysplat.rendering import render
from benchmarks import systems
from benchmarks.pareto import find_scenes
from benchmarks.systems import CURVES, NETWORK, SPEEDS, RefinedSystem, measure_refinement

MARKS = [0.1, 0.2]
PHOTOGRAPHS = {"side": 32, "inputs": 4, "targets": 2}


@pytest.fixture
def small(make_options, tmp_path):
    config = make_options("systems", {})
    config.systems.merge_with({"shared": str(tmp_path), "scenes": ["room", "fern"]})
    config.systems.merge_with({"photographs": PHOTOGRAPHS, "marks": MARKS})
    return config


@pytest.mark.medium
def test_every_system_has_a_row_for_each_mark(small):
    results = systems.measure(small, Console(quiet=True))
    assert "fern" in results["not_measured"] and "LPIPS" in results["not_measured"]
    for name, expected in {NETWORK: list(SPEEDS), **dict.fromkeys(CURVES, MARKS)}.items():
        rows = [row for row in results["rows"] if row["system"] == name]
        assert [row["mark"] for row in rows] == expected, name
        seconds = [row["seconds"] for row in rows]
        assert seconds == sorted(seconds) or name == NETWORK
        assert all(row["psnr"] > 10 and row["gaussians"] > 0 for row in rows), name
    results["machine"] = {"cpu": "any", "instructions": "", "cores": 1, "threads": 1}
    for table in systems.tables(results):
        assert table.row_count == len(SPEEDS) + len(MARKS) * len(CURVES)
    (axes,) = systems.plot(results).axes  # without LPIPS
    assert len(axes.lines) == 1 + len(CURVES)


def test_a_refinement_is_measured_as_it_is_after_its_last_step(tmp_path):
    """With a schedule that is cut, the last mark's scene is that of as many of 30,000 steps."""
    photographs = find_scenes(["room"], tmp_path)[0]["room"](**PHOTOGRAPHS)
    curve, seen = RefinedSystem("plane_sweep", CURVES["3DGS"].settings, cut=True), []
    rows = measure_refinement(photographs, curve, [0.05], lambda image: seen.append(image) or {})
    steps = rows[-1]["steps"]
    gaussians = initial_gaussians("plane_sweep", photographs.inputs, curve.settings)
    color = photographs.inputs.mean_color()
    stop = lambda progress, _: progress.step == steps  # noqa: E731
    refined = refine(
        gaussians, photographs.inputs, curve.settings, steps=30_000, background=color, watch=stop
    )
    expected = render(refined, photographs.held_out.cameras, color, depth=False).image
    assert torch.equal(seen[-1], expected)
    assert rows[-1]["gaussians"] == refined.num_gaussians


def test_mistakes_are_named(small):
    small.systems.marks = [2, 1]
    with pytest.raises(InputError, match=r"systems\.marks=\[2, 1\]: give increasing seconds above"):
        systems.measure(small, Console(quiet=True))
