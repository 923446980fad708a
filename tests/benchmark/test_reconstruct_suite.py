"""The suite on small scenes: what it finds is complete, and is what a refinement gives."""

import json
import runpy

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.reconstruct import suite
from asysplat.benchmark.reconstruct.scene import MeasuredScene
from asysplat.benchmark.reconstruct.shown import METRICS, compare_parts, plot, tables
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.scene import measure_scene
from asysplat.refinement import RefinementSettings, mean_color, refine
from asysplat.refinement.photographs import open_photographs

SIDE = 32
MOST = 300  # Gaussians
PROTOCOL = Protocol("test", False, "gaussian", "biased", "alex", "images", "none")
BUDGETS = [0.01, 0.02]  # seconds: a step or some
PARTS = {"none": {"densify": "none"}, "exposed": {"rates": {"exposure": 0.003}}}
PARTS["elsewhere"] = {"init": "network", "densify": "none"}


@pytest.fixture(scope="module")
def shared_folder(tmp_path_factory):
    """A folder with data/room, of 24 photographs."""
    folder = tmp_path_factory.mktemp("shared")
    write_photographs(folder / "data" / "room", 24, 48, 48)
    return folder


@pytest.fixture(scope="module")
def make_options(repository, shared_folder):
    """The options of conf/benchmark.yaml, made small and changed."""

    def options(**changes):
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            found = compose(
                "benchmark", ["suite=reconstruct", "repeats=2", "~reconstruct.variants"]
            )
        found.refinement.most = MOST
        OmegaConf.set_struct(found.reconstruct, False)
        small = {"shared": str(shared_folder), "scenes": ["room"], "inits": ["plane_sweep"]}
        small |= {"budgets": BUDGETS, "budget": BUDGETS[0], "variants": PARTS}
        found.reconstruct.merge_with(small | changes)
        return found

    return options


@pytest.fixture(scope="module")
def measured(repository, make_options, tmp_path_factory):
    """The numbers that benchmark.py writes, and what it says."""
    folder = tmp_path_factory.mktemp("benchmark")
    script = runpy.run_path(str(repository / "benchmark.py"))
    console = Console(record=True, width=200)
    options = make_options(scenes=["room", "nowhere"], inits=["plane_sweep", "points"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(suite, "SIDE", SIDE)
        patch.setitem(script["benchmark"].__globals__, "Console", lambda: console)
        script["benchmark"](OmegaConf.merge(options, {"output": str(folder)}))
    assert (folder / "reconstruct.png").stat().st_size > 0
    numbers = (folder / "reconstruct.json").read_text()
    return json.loads(numbers, parse_constant=pytest.fail), console.export_text()


@pytest.fixture(scope="module")
def scene(shared_folder):
    photographs = open_photographs(shared_folder / "data" / "room", SIDE, SIDE)
    return MeasuredScene(photographs, PROTOCOL, None)


@pytest.mark.medium
def test_rows_are_complete_and_consistent(measured):
    results, said = measured
    assert results["complete"] and results["variants"] == PARTS
    assert results["scenes"] == {"room": {"inputs": 21, "measured": 3}}
    rows = [(r["variant"], r.get("init"), r.get("budget")) for r in results["rows"]]
    short, long = BUDGETS
    assert rows == [
        ("nearest view", None, None),
        ("mean color", None, None),
        ("start", "plane_sweep", 0),
        ("all", "plane_sweep", short),
        ("all", "plane_sweep", long),
        ("none", "plane_sweep", short),
        ("exposed", "plane_sweep", short),
        ("start", "network", 0),
        ("elsewhere", "network", short),
    ]
    assert "left out: init=points: " in said and "nowhere is left out: " in said
    for row in results["rows"]:
        assert row["scene"] == "room" and row["psnr"] > 5 and -1 < row["ssim"] < 1
    refined = [row for row in results["rows"][2:] if row["variant"] != "start"]
    start = results["rows"][2]
    assert start["gaussians"] <= MOST and start["start"] > 0
    for row in refined:
        assert row["steps"] >= 1 and row["gaussians"] <= MOST
        # The clock stops after the step in which the budget is used.
        assert row["seconds_a_step"] * row["steps"] >= row["budget"]
        ratio = row["step"]["median"] / row["renderer"]["median"]
        assert row["over_renderer"] == pytest.approx(ratio) and ratio > 1
    assert [len(table.rows) for table in tables(results)] == [9, 7, 4]


def test_a_row_is_what_a_refinement_of_so_many_steps_gives(scene):
    photographs = scene.photographs
    inputs, targets = photographs.inputs, photographs.measured
    background = mean_color(inputs)
    start, first = scene.start("plane_sweep", MOST)
    fields = [field.clone() for field in vars(start).values()]
    row = scene.refined(start, RefinementSettings(most=MOST), 1, steps=6)
    assert all(map(torch.equal, fields, vars(start).values()))
    gaussians = refine(start, inputs, RefinementSettings(most=MOST), steps=6, background=background)
    assert (row["steps"], row["gaussians"]) == (6, gaussians.num_gaussians)
    for found, of in ((first, start), (row, gaussians)):
        expected = measure_scene(of, targets, background, PROTOCOL)
        for name in ("psnr", "ssim"):
            assert found[name] == pytest.approx(sum(expected[name]) / 3, abs=1e-5)


def test_baselines_are_those_of_the_views_held_out(scene):
    nearest, mean = scene.for_nothing()
    assert (nearest["variant"], mean["variant"]) == ("nearest view", "mean color")
    inputs, targets = scene.photographs.inputs, scene.photographs.measured
    color = inputs.images.mean((0, 2, 3))[:, None, None]
    flat = psnr(color.expand_as(targets.images), targets.images).mean().item()
    assert mean["psnr"] == pytest.approx(flat, abs=1e-4)
    every = torch.stack(
        [psnr(one.expand_as(targets.images), targets.images) for one in inputs.images]
    )
    assert every.amin(0).mean() < nearest["psnr"] < every.amax(0).mean() + 1e-4


def test_a_goal_is_reached_at_the_first_look_that_is_as_good():
    curve = [(1.0, 20.0), (1.5, 24.5), (2.0, 23.0), (3.0, 25.0)]
    assert suite.seconds_to(24, 0.5, curve) == 2.0
    assert suite.seconds_to(25.5, 0.5, curve) is None


def test_looks_on_the_way_are_at_what_was_there_then(scene, monkeypatch):
    monkeypatch.setattr("asysplat.benchmark.reconstruct.scene.FIRST_LOOK", 1e-4)
    start, first = scene.start("plane_sweep", MOST)
    curve = scene.refined(start, RefinementSettings(most=MOST), 1, steps=12)["curve"]
    assert len(curve) > 3 and [seconds for seconds, _ in curve] == sorted(s for s, _ in curve)
    assert abs(curve[0][1] - first["psnr"]) < 1.5 and curve[0][1] != curve[-1][1]


def row(scene, variant, budget=30, init="plane_sweep", **metrics):
    return {"scene": scene, "variant": variant, "init": init, "budget": budget, **metrics}


def test_parts_are_compared_with_the_whole_scene_by_scene():
    rows = [
        row("a", "start", 0, psnr=1.0),
        row("a", "all", 10, psnr=0.0, lpips=0.0),
        row("a", "all", psnr=20.0, lpips=0.2),
        row("a", "part", psnr=19.0, lpips=None),
        row("a", "all", init="points", psnr=50.0),
        row("b", "all", psnr=30.0, lpips=0.4),
    ]
    results = {"rows": rows, "inits": ["plane_sweep", "points"], "budget": 30}
    whole, part, other = compare_parts(results | {"variants": {"part": {}, "other": {}}})
    nothing = dict.fromkeys(METRICS)
    means = {"psnr": 25.0, "lpips": pytest.approx(0.3)}
    assert whole == {"variant": "all", "scenes": 2} | nothing | means
    assert part == {"variant": "part", "scenes": 1} | nothing | {"psnr": -1.0}
    assert other == {"variant": "other", "scenes": 0} | nothing


@pytest.mark.medium
def test_the_picture_has_curves_levels_and_marks(measured):
    results, _ = measured
    (axes,) = plot(results).axes  # LPIPS needs weights that are not here
    assert axes.get_title() == "room" and axes.get_ylabel() == "PSNR, dB"
    by_name = {(r["variant"], r.get("budget")): r["psnr"] for r in results["rows"]}
    drawn = [list(line.get_ydata()) for line in axes.lines]
    assert [by_name["all", budget] for budget in BUDGETS] in drawn
    for level in (by_name["nearest view", None], by_name["start", 0]):
        assert [level, level] in drawn
    for name in PARTS:
        assert [by_name[name, BUDGETS[0]]] in drawn
    assert [by_name["mean color", None]] * 2 not in drawn


@pytest.mark.parametrize("finished", [0, 1])
def test_what_was_measured_is_kept_when_it_is_stopped(make_options, monkeypatch, finished):
    calls = []

    def refined(*_, **limit):
        calls.append(limit)
        if len(calls) > finished:
            raise KeyboardInterrupt
        numbers = {"psnr": 20.0, "gaussians": 3, "steps": 1, "seconds_a_step": 1.0, "curve": []}
        return numbers | {"renderer": {"median": 1.0, "iqr": 0.0}, "over_renderer": 1.0}

    monkeypatch.setattr(suite, "SIDE", SIDE)
    monkeypatch.setattr(MeasuredScene, "refined", refined)
    console = Console(record=True)
    results = suite.measure(make_options(), console)
    assert calls == [{"seconds": budget} for budget in BUDGETS[: finished + 1]]
    assert not results["complete"] and len(results["rows"]) == 3 + finished
    assert "stopped: what was measured so far is kept." in console.export_text()
    captions = [table.caption for table in tables(results | {"machine": {"cpu": "one"}})]
    assert "the suite was stopped before its end" in captions[0]
    assert plot(results).axes


def test_what_is_stopped_before_it_measured_anything_has_no_results(make_options, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(suite, "open_photographs", lambda *_, **__: stopped())
    with pytest.raises(KeyboardInterrupt):
        suite.measure(make_options(), Console())


MISTAKES = {
    "an init": ({"inits": ["depths"]}, r"^reconstruct\.inits=depths is unknown: choose from"),
    "no init": ({"inits": []}, r"^reconstruct\.inits=None is unknown"),
    "a budget": ({"budgets": [10, 0]}, r"^reconstruct has the budget 0: give seconds"),
    "a budget of variants": ({"budget": "long"}, r"^reconstruct has the budget long: give"),
    "a scene": ({"scenes": ["ferns"]}, r"^reconstruct\.scenes=\['ferns'\]: none is a folder of .*"),
    "a setting": ({"variants": {"a": {"densfy": "none"}}}, r"variants\.a: .*densfy.* no settings"),
    "a value": (
        {"variants": {"a": {"half_size": 2.0}}},
        r"variants\.a: refinement\.half_size=2\.0: ",
    ),
    "another start": ({"variants": {"a": {"init": "dust"}}}, r"variants\.a\.init=dust is unknown"),
    "no settings": ({"variants": {"a": 3}}, r"variants\.a: 3 are no settings of a refinement\."),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(make_options, mistake):
    changes, says = MISTAKES[mistake]
    options = make_options(**{"variants": None} | changes)
    with pytest.raises(InputError, match=says) as raised:
        suite.measure(options, Console())
    assert "\n" not in str(raised.value)


@pytest.mark.medium
def test_photographs_with_depths(shared):
    folder = shared / "data" / "hololens-000"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    scene = MeasuredScene(open_photographs(folder, 64, 64), PROTOCOL, None)
    nearest, _ = scene.for_nothing()
    sweep, found = scene.start("plane_sweep", 20_000)
    _, true = scene.start("depth", 20_000)
    refined = scene.refined(sweep, RefinementSettings(most=20_000), 1, steps=64)
    assert refined["psnr"] > found["psnr"] > nearest["psnr"]
    assert true["absrel"] < found["absrel"] and true["delta1"] > found["delta1"]
