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

MARKS = [0.2, 0.4]


@pytest.fixture(scope="module")
def small(make_options, tmp_path_factory):
    config = make_options("systems", {})
    nothing = tmp_path_factory.mktemp("shared")
    photographs = {"side": 32, "inputs": 4, "targets": 2}
    config.systems.merge_with({"shared": str(nothing), "scenes": ["room", "fern"]})
    config.systems.merge_with({"photographs": photographs, "marks": MARKS})
    return config


@pytest.fixture(scope="module")
def results(small):
    return systems.measure(small, Console(quiet=True))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    scenes, _ = find_scenes(["room"], tmp_path_factory.mktemp("data"))
    return scenes["room"](side=32, inputs=4, targets=2)


@pytest.mark.medium
def test_every_system_has_a_row_for_each_mark(results):
    assert "fern" in results["not_measured"] and "LPIPS" in results["not_measured"]
    marks = {NETWORK: list(SPEEDS)} | dict.fromkeys(CURVES, MARKS)
    for name, expected in marks.items():
        rows = [row for row in results["rows"] if row["system"] == name]
        assert [row["mark"] for row in rows] == expected, name
        assert [row["seconds"] for row in rows] == sorted(row["seconds"] for row in rows) or (
            name == NETWORK
        )
        for row in rows:
            assert row["psnr"] > 10 and row["gaussians"] > 0


@pytest.mark.medium
def test_tables_and_plot_show_every_system(results):
    machine = {"cpu": "any", "instructions": "", "cores": 1, "threads": 1}
    shown = results | {"machine": machine}
    per_scene, means = systems.tables(shown)
    assert per_scene.row_count == means.row_count == len(SPEEDS) + len(MARKS) * len(CURVES)
    (axes,) = systems.plot(shown).axes  # without LPIPS
    assert len(axes.lines) == 1 + len(CURVES)


def test_a_refinement_is_measured_as_it_is_after_its_last_step(photographs):
    """With a schedule that is cut, the last mark's scene is that of as many of 30,000 steps."""
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"marks": [2, 1]}, r"systems\.marks=\[2, 1\]: give increasing seconds above 0"),
        ({"marks": []}, r"systems\.marks=\[\]"),
        ({"names": ["4DGS"]}, r"systems\.names=4DGS is unknown: choose from AsySplat, one pass"),
        ({"scenes": ["nowhere"]}, r"systems\.scenes=nowhere is unknown"),
    ],
)
def test_a_mistake_is_one_sentence(small, changes, message):
    config = small.copy()
    for name, value in changes.items():
        config.systems[name] = value
    with pytest.raises(InputError, match=message):
        systems.measure(config, Console(quiet=True))
