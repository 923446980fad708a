"""The suite on a small scene: its results are complete, and are those of its parts."""

import pytest
import torch
from rich.console import Console

from asysplat import load
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.rendering import render
from benchmarks import pareto
from benchmarks.pareto import BASE, average_scenes, find_scenes, plot, select_inputs, tables

SIDE = 32
VARIANTS = {
    "feed_forward": {
        "side_16": {"side": 16},
    },
    "networks": {
        "8m": {"overrides": ["model.layers=1m", "width=0.125", "state_size=8"]},
        "bf16": {"precision": "bf16"},
        "side_24": {"side": 24},  # which networks cannot take
    },
    "refined": {"no_densify": {"refinement": {"densify": "none"}}},
    "reconstruct": {
        "start": {"seconds": None, "steps": 0},
        "from_points": {"init": "points"},  # of which the scene has none
    },
}
ABSENT = {"side_24": "multiples of 16", "from_points": "no sparse points"}
SMALL = {
    "feed_forward": {"views": 3},
    "networks": {"views": 3, "overrides": ["model.layers=1m1s", "width=0.125", "state_size=8"]},
    "refined": {"views": 4, "steps": 3},
    "reconstruct": {"seconds": 0.01},
}


@pytest.fixture(scope="module")
def make_pareto(make_options, tmp_path_factory):
    """The options of conf/benchmark.yaml, made small and changed."""
    nothing = tmp_path_factory.mktemp("shared")

    def options(**changes):
        config = make_options("pareto", {"repeats": 1})
        wanted = config.pareto
        wanted.merge_with({"shared": str(nothing), "scenes": ["room", "fern"], "side": SIDE})
        for family, variants in VARIANTS.items():
            wanted[family].variants = variants
            wanted[family].base.merge_with(SMALL[family])
        sizes = {"side": SIDE, "inputs": 8, "targets": 2}
        wanted.reconstruct.merge_with({"scenes": ["room"], "photographs": sizes})
        wanted.merge_with({"families": list(VARIANTS)} | changes)
        return config

    return options


@pytest.mark.medium
def test_rows_are_complete_and_errors_grow_with_what_is_left_out(make_pareto, run_suite, tmp_path):
    results = run_suite("pareto", make_pareto())
    rows = {(row["family"], row["setting"]): row for row in results["rows"]}
    assert list(rows) == [(f, name) for f, others in VARIANTS.items() for name in (BASE, *others)]
    for (family, name), row in rows.items():
        if name in ABSENT:
            assert ABSENT[name] in row["not_measured"]
            assert {row[key] for key in ("seconds", "over_base", "psnr")} == {None}
            continue
        assert row["not_measured"] is None and row["seconds"]["median"] > 0
        assert name != BASE or row["over_base"]["median"] == 1
        assert (row["psnr"] is None) == (family == "networks")
        assert (row["error"] is None) == (name == BASE and family in ("refined", "reconstruct"))
    absent = results["not_measured"]
    assert absent["fern"].endswith("is no folder") and "networks, room, side_24" in absent

    decibels = {key: row["error"]["decibels"] for key, row in rows.items() if row["error"]}
    assert decibels["feed_forward", BASE] > 60 > decibels["feed_forward", "side_16"] > 10
    # Other layers are compared with their own float64, not with the base's.
    others = [decibels["networks", name] for name in (BASE, "8m")]
    assert min(others) > 70 and min(others) > decibels["networks", "bf16"] > 30

    scene = select_inputs(find_scenes(["room"], tmp_path)[0]["room"](SIDE, 16, 4), 3, SIDE)
    with torch.no_grad():
        gaussians, background = load()(scene.inputs), scene.inputs.mean_color()
        image = render(gaussians, scene.held_out.cameras, background, depth=False).image
    found = rows["feed_forward", BASE]["psnr"]
    assert found == pytest.approx(psnr(image, scene.held_out.images).mean().item(), abs=1e-4)


def make_row(family, scene, setting, seconds, psnr=None, error=None):
    row = {"family": family, "scene": scene, "setting": setting, "not_measured": None}
    row |= {"psnr": psnr, "lpips": None, "error": error and {"decibels": error}}
    timed = seconds and {"median": seconds, "iqr": 0.0, "busy": False}
    over = seconds and {"median": seconds / 4.0, "iqr": 0.0, "busy": False}
    return row | {"seconds": timed, "over_base": over}


def test_means_are_over_scenes_and_dominated_points_are_not_on_the_curve():
    rows = [
        make_row("refined", "a", BASE, 4.0, 30.0),
        make_row("refined", "b", BASE, 4.0, 20.0),
        make_row("refined", "a", "quick", 1.0, 29.0, 40.0),
        make_row("refined", "b", "quick", 4.0, 19.5, 30.0),
        make_row("refined", "a", "slow", 8.0, 24.0),
        make_row("refined", "a", "absent", None),
    ]
    means = {row["setting"]: row for row in average_scenes(rows)}
    quick = means["quick"]
    assert (quick["scenes"], quick["seconds"], quick["psnr"]) == (2, 2.5, 24.25)
    assert quick["over_base"] == pytest.approx(0.5)  # the geometric mean
    assert (quick["lost"], quick["error"]) == (0.75, 35.0)
    assert means["absent"]["scenes"] == 0 and means["absent"]["psnr"] is None

    results = {"machine": {"cpu": "one"}, "rows": rows, "not_measured": {}}
    assert tables(results)[-1].row_count > 0
    panels = {axes.get_ylabel(): axes for axes in plot(results).axes}
    of_refined = panels[pareto.QUALITIES["psnr"]]
    assert {text.get_text() for text in of_refined.texts} == {BASE, "quick", "slow"}
    line, *_ = of_refined.lines
    assert list(line.get_xdata()) == [2.5, 4.0] and list(line.get_ydata()) == [24.25, 25.0]


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"families": ["refine"]}, r"^pareto\.families=refine is unknown: choose from "),
        ({"scenes": ["fern"]}, r"^pareto\.scenes=\['fern'\]: none is a folder of"),
        (
            {"feed_forward": {"variants": {"a": {"precison": "bf16"}}}},
            r"feed_forward\.a=precison is unknown: choose from v",
        ),
        (
            {"refined": {"variants": {"a": {"views": 0}}}},
            r"refined\.a: views=0: give a whole number from 1\.",
        ),
    ],
)
def test_mistakes_are_named(make_pareto, changes, sentence):
    with pytest.raises(InputError, match=sentence):
        pareto.measure(make_pareto(**changes), Console(quiet=True))
