"""Suites at their smallest cases: rows are complete, and faults and slower workloads are seen."""

from functools import partial

import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.errors import InputError
from asysplat.refinement import refine
from asysplat.refinement.init import initial_gaussians
from asysplat.rendering import render as draw
from benchmarks import bench, data, model, ops, render, systems
from benchmarks.compare import compare
from benchmarks.options import describe_machine, find_suite
from benchmarks.pareto import find_scenes
from benchmarks.scenes import SCENES, SMALLER, pixel_aligned_scene, random_scene

LENGTH, LOOP_TOKENS = 150, 50
OPERATORS = {
    "ssd": {"batch": 1, "length": LENGTH, "heads": 8, "head_dim": 16, "state": 8},
    "selective_scan": {"batch": 2, "length": LENGTH, "channels": 16, "state": 4},
    "grid_attention": {"batch": 1, "views": 2, "height": 4, "width": 6, "heads": 2, "head_dim": 8}
    | {"grids": [1, 2]},
    "plane_sweep": {"batch": 1, "views": 4, "height": 24, "width": 32}
    | {"planes": 20, "neighbors": 2},
    "loop_tokens": LOOP_TOKENS,
    "exact": {
        "ssd": {"length": 140},  # all heads: few numbers would make an error of A's gradient chance
        "selective_scan": {"batch": 1},
        "grid_attention": {"views": 1},
        "plane_sweep": {"views": 3},
    },
}
# A pixel of the sweep whose best two planes cost the same to the last bit may turn.
BOUNDS = {"fp32": 2e-6, "bf16": 1e-2, "plane_sweep": 1e-5}
MARKS = [0.05, 0.1]
PHOTOGRAPHS = {"side": 32, "inputs": 4, "targets": 2}


def test_a_workload_that_became_slower_is_named(monkeypatch):
    numbers, threads = torch.rand(200_000), torch.get_num_threads()

    def work(count):
        for _ in range(count):
            numbers.sin().sum().item()

    def measure(*times):
        pairs = [
            bench.Pair(f"{i}", "once", partial(work, n), partial(work, 8))
            for i, n in enumerate(times)
        ]
        monkeypatch.setattr(bench, "make_pairs", lambda: pairs)
        found = bench.measure(OmegaConf.create({"repeats": 5}), Console(quiet=True))
        return {"machine": describe_machine(), **found}

    old = measure(8, 4)
    assert torch.get_num_threads() == threads
    ratios = [row["ratio"]["median"] for row in old["rows"]]
    assert 1.3 < ratios[0] / ratios[1] < 3
    assert compare(old, old, bench.TRACKED).worse == []
    (worse,) = compare(old, measure(8, 32), bench.TRACKED).worse
    assert worse.startswith("slower: 1/once, ratio: ")


@pytest.mark.medium
def test_photographs_and_prepared_scenes_are_loaded(run_suite):
    small = {"scenes": 2, "frames": 24, "photographs": [36, 64], "num_workers": 0}
    small |= {"views": [16, 16], "inputs": 4, "targets": 2, "tasks": 2}
    results = run_suite("data", {"data": small})
    assert results["scenes"]["frames"] == 24 and results["prepare"] > 0
    assert [row["source"] for row in results["loading"]] == list(data.SOURCES)
    assert all(row["views_per_second"]["median"] > 0 for row in results["loading"])
    assert [row["container"] for row in results["containers"]] == ["tar", "zip", "prepared"]


@pytest.mark.medium
def test_parts_of_a_network_are_timed(run_suite):
    overrides = {"scale": "laptop", "width": 0.125, "state_size": 8, "model.layers": "1m1s1t"}
    options = {"overrides": overrides, "precisions": ["fp32"], "names": ["asysplat_4m4s"]}
    options |= {"views": [1], "scenes": 2, "checkpoint_layers": True}
    (row,) = run_suite("model", {"model": options, "repeats": 1})["rows"]
    assert row["parameters"] > 1e5 and row["step_gb"] > 0.1
    assert row["forward"]["median"] > 0 and row["step"]["median"] > 0
    seconds = {name: part["seconds"]["median"] for name, part in row["components"].items()}
    assert set(seconds) == {*model.COMPONENTS, model.OTHERS} and min(seconds.values()) > 0
    for operator, component in {"ssd": "Mamba2", "selective_scan": "MambaVision"}.items():
        assert row["operators"][operator]["median"] < seconds[component]


@pytest.mark.medium
def test_operators_are_within_their_bounds_and_ratios_are_those_of_the_times(run_suite):
    results = run_suite("ops", {"ops": OPERATORS})
    rows = {(row["operator"], row["precision"], row["path"]): row for row in results["rows"]}
    for (operator, precision, path), row in rows.items():
        error, sweep = row["error"], operator == "plane_sweep"
        assert (error["gradients"] is None) == (row["forward_backward"] is None) == sweep
        worst = max(error["forward"], *(error["gradients"] or {}).values(), 0)
        bound = BOUNDS["plane_sweep" if sweep else precision]
        assert 0 < worst < bound, (operator, precision, path)
        loop = rows.get((operator, "fp32", "loop")) or rows.get((operator, "fp32", "reference"))
        assert bool(loop) == bool(row["faster_than_loop"])
        for name in (name for name in ops.PASSES if row[name] and loop):
            expected = loop[name]["median"] / row[name]["median"]
            assert row["faster_than_loop"][name] == pytest.approx(expected)
    paths = {name: {path for other, _, path in rows if other == name} for name, _, _ in rows}
    assert paths.keys() == {*ops.SCANS, "grid_attention/1", "grid_attention/2", "plane_sweep"}
    assert paths["plane_sweep"] == {"reference", "cpu"}
    assert all({"loop", "cpu"} <= paths[name] for name in ops.SCANS)


@pytest.mark.medium
def test_rendering_without_a_kind_of_culling_has_the_same_error(run_suite, monkeypatch):
    monkeypatch.setitem(SCENES, "twin", partial(pixel_aligned_scene, 16, 32, 32))
    monkeypatch.setitem(SMALLER, "twin", partial(pixel_aligned_scene, 8, 16, 16))
    results = run_suite("render", {"scenes": ["twin"]})
    rows = {(row["backend"], row["without"]): row for row in results["rows"]}
    for row in rows.values():
        assert (row["gaussians"], row["height"], row["width"], row["views"]) == (512, 32, 32, 1)
        assert row["error"]["measured_on"]["gaussians"] == 128
        assert 0 <= row["error"]["image_p99"] <= row["error"]["image_max"]
        assert row["forward"]["median"] > 0 and row["backward"]["median"] > 0
    assert ("reference", None) in rows
    of_cpu = {off: rows["cpu", off] for off in (None, *render.CULLING)}
    assert all(row["error"] == of_cpu[None]["error"] for row in of_cpu.values())
    assert of_cpu["rows"]["stats"]["rows"] > of_cpu[None]["stats"]["rows"]


def test_errors_are_those_of_image_and_gradients():
    scene = random_scene(200, 20, 20)
    exact = render.run_exact(scene)
    outputs = render.run_passes(render.find_backends()[0], render.prepare_inputs(scene))
    none = render.find_flips(exact, exact)
    close = render.measure_errors(outputs, exact, none)
    assert not none.any() and 0 < close["image_max"] < 1e-3
    assert max(close["gradients"].values()) < 1e-2

    image = exact.image.clone()
    image[0, 0, 0, 0] += 1
    gradients = (exact.gradients[0] * 1.5, *exact.gradients[1:])
    other = exact._replace(image=image, gradients=gradients)
    wrong = render.measure_errors(other, exact, none)
    assert wrong["image_max"] == pytest.approx(1) and wrong["image_p99"] == 0
    expected = {name: 0.5 * (name == "means") for name in render.FIELDS}
    assert wrong["gradients"] == pytest.approx(expected)
    flipped = render.find_flips(other, exact)
    assert flipped.sum() == 1 and flipped[0, 0, 0]
    assert render.measure_errors(other, exact, flipped)["image_max"] == 0


@pytest.fixture
def small_systems(make_options, tmp_path):
    config = make_options("systems", {})
    config.systems.merge_with({"shared": str(tmp_path), "scenes": ["room", "fern"]})
    config.systems.merge_with({"photographs": PHOTOGRAPHS, "marks": MARKS})
    return config


@pytest.mark.medium
def test_every_system_has_a_row_for_each_mark(small_systems):
    results = systems.measure(small_systems, Console(quiet=True))
    assert "fern" in results["not_measured"] and "LPIPS" in results["not_measured"]
    for name in systems.CURVES:
        rows = [row for row in results["rows"] if row["system"] == name]
        assert [row["mark"] for row in rows] == MARKS, name
        seconds = [row["seconds"] for row in rows]
        assert seconds == sorted(seconds)
        assert all(row["psnr"] > 10 and row["gaussians"] > 0 for row in rows), name


def test_a_refinement_is_measured_as_it_is_after_its_last_step(tmp_path):
    """With a schedule that is cut, the last mark's scene is that of as many of 30,000 steps."""
    photographs = find_scenes(["room"], tmp_path)[0]["room"](**PHOTOGRAPHS)
    views, cameras = photographs.inputs, photographs.held_out.cameras
    curve = systems.RefinedSystem("plane_sweep", systems.CURVES["3DGS"].settings, cut=True)
    seen, color = [], views.mean_color()
    (*_, row) = systems.measure_refinement(
        photographs, curve, [0.05], lambda picture, _: seen.append(picture(cameras)) or {}
    )
    refined = refine(
        initial_gaussians("plane_sweep", views, curve.settings.initial_limit),
        views,
        curve.settings,
        steps=30_000,
        background=color,
        watch=lambda progress, _: progress.step == row["steps"],
    )
    assert torch.equal(seen[-1], draw(refined, cameras, color, depth=False).image)
    assert row["gaussians"] == refined.num_gaussians


def test_mistakes_are_named(run_script, tmp_path, small_systems):
    with pytest.raises(InputError, match=r"^suite=rendr is unknown: choose from render, ops, mode"):
        find_suite("rendr")
    with pytest.raises(InputError, match=r"^scenes=D is unknown: .*A, B, C, 524k, 4M"):
        render.measure(OmegaConf.create({"scenes": ["A", "D"]}), Console(quiet=True))
    small_systems.systems.marks = [2, 1]
    with pytest.raises(InputError, match=r"systems\.marks=\[2, 1\]: give increasing seconds above"):
        systems.measure(small_systems, Console(quiet=True))
    done = run_script("benchmark.py", "repeats=0", f"output={tmp_path}")
    assert done.returncode == 1 and done.stderr.startswith("error: repeats=0 cannot be")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
