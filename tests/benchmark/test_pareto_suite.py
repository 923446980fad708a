"""The suite on a small scene: what it finds is complete, and is what the parts give."""

import json

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.pareto import suite
from asysplat.benchmark.pareto.measured import picture_error
from asysplat.benchmark.pareto.scenes import find_scenes
from asysplat.benchmark.pareto.settings import BASE, FAMILIES, find_settings
from asysplat.benchmark.pareto.shown import plot, summarize, tables
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.refinement import mean_color
from asysplat.rendering import render
from asysplat.training.load import load

SIDE = 32
KNOBS = {
    "feed_forward": {
        "bf16": {"precision": "bf16"},
        "side_16": {"side": 16},
        "one_view_at_once": {"views_at_once": 1},
        "fewer": {"least_opacity": 0.2, "most": 500, "sh_degree": 0},
        "side_24": {"side": 24},  # which the network cannot take
    },
    "networks": {"8m": {"overrides": ["model.layers=1m", "width=0.125", "state_size=8"]}},
    "refined": {"one_step": {"steps": 1}, "no_densify": {"refinement": {"densify": "none"}}},
}
SMALL = {
    "feed_forward": {"views": 3},
    "networks": {"views": 3, "overrides": ["model.layers=1m1s", "width=0.125", "state_size=8"]},
    "refined": {"views": 4, "steps": 3},
}


@pytest.fixture(scope="module")
def make_options(repository, tmp_path_factory):
    """The options of conf/benchmark.yaml, made small and changed."""
    shared = tmp_path_factory.mktemp("shared")

    def options(**changes):
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            found = compose("benchmark", ["suite=pareto", "repeats=2", "device=cpu"])
        OmegaConf.set_struct(found, False)
        wanted = found.pareto
        wanted.merge_with({"shared": str(shared), "scenes": ["room", "fern"], "side": SIDE})
        for family, knobs in KNOBS.items():
            wanted[family].knobs = knobs
            wanted[family].base.merge_with(SMALL[family])
        wanted.merge_with(changes)
        return found

    return options


@pytest.fixture(scope="module")
def measured(make_options):
    options = make_options()
    found = suite.measure(options, Console(quiet=True))
    return options, {"machine": {"cpu": "one"}, "revision": "r", **found}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    scenes, _ = find_scenes(["room"], tmp_path_factory.mktemp("none"), SIDE)
    return scenes["room"]()


@pytest.mark.medium
def test_rows_are_complete_and_strict(measured):
    options, results = measured
    json.dumps(results, allow_nan=False)
    wanted = OmegaConf.to_container(options.pareto, resolve=True)
    rows = {(row["family"], row["setting"]): row for row in results["rows"]}
    assert list(rows) == [(f, name) for f, knobs in KNOBS.items() for name in (BASE, *knobs)]
    for (family, name), row in rows.items():
        assert (row["scene"], row["side"]) == ("room", SIDE)
        of_family = wanted[family]
        asked = of_family["base"] | of_family["knobs"].get(name, {})
        assert {key: row["values"][key] for key in asked} == asked
        if name == "side_24":
            assert "multiples of 16" in row["not_measured"]
            assert {row[key] for key in ("seconds", "over_base", "peak_gb", "psnr")} == {None}
            continue
        assert row["not_measured"] is None and row["lpips"] is None
        assert row["seconds"]["median"] > 0 and row["peak_gb"] >= 0
        assert (row["psnr"] is None) == (family == "networks")
        assert (row["error"] is None) == ((family, name) == ("refined", BASE))
    for family in KNOBS:
        ratio = rows[family, BASE]["over_base"]
        assert (ratio["median"], ratio["iqr"]) == (1, 0)


@pytest.mark.medium
def test_what_is_absent_is_not_measured(measured):
    _, results = measured
    absent = results["not_measured"]
    assert absent["fern"].endswith("is no folder") and "weights" in absent["LPIPS"]
    assert "feed_forward, room, side_24" in absent
    assert ("a GPU" in absent) != torch.cuda.is_available()
    captions = [table.caption for table in tables(results)]
    assert "not measured: fern, " in captions[-1]


@pytest.mark.medium
def test_errors_grow_with_what_is_left_out(measured):
    _, results = measured
    errors = {(r["family"], r["setting"]): r["error"] for r in results["rows"] if r["error"]}
    decibels = {name: error["decibels"] for name, error in errors.items()}
    base, bf16, side = (decibels["feed_forward", name] for name in (BASE, "bf16", "side_16"))
    assert base > 70 and base > bf16 > side > 10
    assert decibels["feed_forward", "one_view_at_once"] == pytest.approx(base, abs=1e-6)
    # Other layers are compared with their own float64, not with the base's.
    assert min(decibels["networks", BASE], decibels["networks", "8m"]) > 70


@pytest.mark.medium
def test_a_row_is_what_the_network_and_the_renderer_give(measured, room):
    _, results = measured
    row = results["rows"][0]
    inputs, targets = room.given(3, SIDE)
    assert inputs.num_views == 3 and room.inputs.num_views > 3
    with torch.no_grad():
        gaussians = load()(inputs)
        image = render(gaussians, targets.cameras, mean_color(inputs), depth=False).image
    assert row["psnr"] == pytest.approx(psnr(image, targets.images).mean().item(), abs=1e-4)


def test_gaussians_that_are_left_out_are_fewer(make_options, room, monkeypatch):
    options, seen = make_options(), []

    def count(gaussians, *args, **kwargs):
        seen.append(
            (gaussians.num_gaussians, gaussians.opacities.min().item(), kwargs["sh_degree"])
        )
        return render(gaussians, *args, **kwargs)

    monkeypatch.setattr("asysplat.benchmark.pareto.settings.render", count)
    settings = suite.find_families(OmegaConf.to_container(options.pareto, resolve=True))
    for name in (BASE, "fewer"):
        draw = settings["feed_forward"][name].prepare(options.refinement, torch.device("cpu"))
        draw(room)
    assert seen[0][0] == 3 * SIDE**2 and seen[0][2] is None
    assert 0 < seen[1][0] <= 500 and seen[1][1] >= 0.05 and seen[1][2] == 0


def test_pictures_that_are_the_same_have_no_infinite_error():
    same = torch.rand(1, 3, 4, 4)
    assert picture_error(same, same) == {"decibels": pytest.approx(200), "max": 0}
    found = picture_error(torch.full((1, 3, 4, 4), 1.5), torch.full((1, 3, 4, 4), 0.9).double())
    assert found == {"decibels": pytest.approx(20), "max": pytest.approx(0.1)}


def test_a_folder_of_photographs_is_a_scene(tmp_path):
    write_photographs(tmp_path / "mine", 12, 40, 60)
    scenes, absent = find_scenes(["mine", "fox"], tmp_path, SIDE)
    scene = scenes["mine"]()
    assert absent.keys() == {"fox"} and scene.name == "mine"
    assert (scene.inputs.num_views, scene.targets.num_views) == (10, 2)
    assert scene.inputs.images.shape[-2:] == (SIDE, SIDE)


def made_up(family, scene, setting, seconds, busy=False, **numbers):
    row = {"family": family, "scene": scene, "setting": setting, "not_measured": None}
    row |= {"psnr": None, "lpips": None, "error": None, "peak_gb": 0.1}
    timed = seconds and {"median": seconds, "iqr": 0.0, "busy": busy}
    over = seconds and {"median": seconds / 4.0, "iqr": 0.0, "busy": False}
    return row | {"seconds": timed, "over_base": over} | numbers


MADE_UP = [
    made_up("refined", "a", BASE, 4.0, psnr=30.0),
    made_up("refined", "b", BASE, 4.0, psnr=20.0),
    made_up("refined", "a", "quick", 1.0, psnr=29.0, error={"decibels": 40.0, "max": 0.1}),
    made_up("refined", "b", "quick", 4.0, True, psnr=19.5, error={"decibels": 30.0, "max": 0.3}),
    made_up("refined", "a", "slow", 8.0, psnr=25.0),
    made_up("refined", "b", "slow", 8.0, psnr=25.0),
    made_up("refined", "a", "absent", None),
    made_up("networks", "a", BASE, 4.0, error={"decibels": 90.0, "max": 0.0}),
    made_up("networks", "a", "other", 3.0, error={"decibels": 80.0, "max": 0.0}),
    made_up("networks", "a", "worse", 3.5, error={"decibels": 70.0, "max": 0.0}),
]


def test_means_are_over_scenes():
    found = {(row["family"], row["setting"]): row for row in summarize(MADE_UP)}
    quick = found["refined", "quick"]
    assert (quick["scenes"], quick["seconds"], quick["psnr"]) == (2, 2.5, 24.25)
    assert quick["over_base"] == pytest.approx(0.5)
    assert (quick["lost"], quick["most_lost"]) == (0.75, 1.0)
    assert (quick["error_decibels"], quick["error_max"]) == (35.0, 0.3)
    assert quick["busy"] and not found["refined", BASE]["busy"]
    absent = found["refined", "absent"]
    assert absent["scenes"] == 0 and absent["seconds"] is absent["psnr"] is absent["lost"] is None
    front = [name for name, row in found.items() if row["on_front"]]
    assert front == [
        ("refined", BASE),
        ("refined", "quick"),
        ("networks", BASE),
        ("networks", "other"),
    ]


def test_tables_and_picture_have_every_setting():
    results = {"machine": {"cpu": "one"}, "rows": MADE_UP, "not_measured": {}}
    results |= {"settings": summarize(MADE_UP)}
    shown = tables(results)
    assert [len(table.rows) for table in shown] == [4, 3, 3, 4, 3]
    cells = {row[0]: row for row in zip(*(c.cells for c in shown[3].columns), strict=True)}
    assert "busy" in cells["quick"] and "*" in cells["quick"]
    assert "-" in cells["absent"] and "0" not in cells["absent"][3:]
    figure = plot(results)
    panels = {(axes.get_title(), axes.get_ylabel()): axes for axes in figure.axes}
    of_refined = next(
        axes
        for (title, label), axes in panels.items()
        if title == "Refined" and "photographs" in label
    )
    names = {text.get_text() for text in of_refined.texts}
    assert names == {BASE, "quick", "slow"}
    line, *dots = of_refined.lines
    assert list(line.get_xdata()) == [2.5, 4.0] and list(line.get_ydata()) == [24.25, 25.0]
    faces = {dot.get_xdata()[0]: dot.get_markerfacecolor() for dot in dots}
    assert faces[2.5] == "none" and faces[4.0] != "none" and faces[8.0] != faces[4.0]
    assert any(text.get_text() == "not measured" for axes in figure.axes for text in axes.texts)


MISTAKES = {
    "a family": ({"families": ["refine"]}, r"^pareto\.families=refine is unknown: choose from "),
    "a knob": ({"knobs": ["bf61"]}, r"^pareto\.knobs=bf61 is unknown: choose from base, bf16, "),
    "a scene": ({"scenes": ["ferns"]}, r"^pareto\.scenes=ferns is unknown: choose from room, "),
    "no scene": ({"scenes": ["fern"]}, r"^pareto\.scenes=\['fern'\]: none is a folder of"),
    "a setting": (
        {"feed_forward": {"knobs": {"a": {"precison": "bf16"}}}},
        r"^pareto\.feed_forward\.a=precison is unknown: choose from views, side, checkpoint, ",
    ),
    "a value": (
        {"feed_forward": {"knobs": {"a": {"precision": "fp8"}}}},
        r"^pareto\.feed_forward\.a: precision=fp8 is unknown: choose from fp32, ",
    ),
    "views": (
        {"refined": {"knobs": {"a": {"views": 0}}}},
        r"^pareto\.refined\.a: views=0: give a whole number from 1\.",
    ),
    "no settings": ({"refined": {"knobs": {"a": 3}}}, r"^pareto\.refined\.a=3 is no setting"),
    "an override": (
        {"feed_forward": {"knobs": {"a": {"overrides": ["model.layer=8m"]}}}},
        r"^model\.layer is unknown: did you mean model\.layers",
    ),
    "weights": (
        {"feed_forward": {"knobs": {"a": {"overrides": ["model.layers=8m"]}}}},
        r"does not fit this model",
    ),
    "a refinement": (
        {"refined": {"knobs": {"a": {"refinement": {"half_size": 2.0}}}}},
        r"^refinement\.half_size=2\.0: give 0 to 1\.",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(make_options, mistake):
    changes, says = MISTAKES[mistake]
    with pytest.raises(InputError, match=says) as raised:
        suite.measure(make_options(**changes), Console(quiet=True))
    assert "\n" not in str(raised.value)


def test_every_knob_of_the_configuration_is_a_setting(repository):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        wanted = OmegaConf.to_container(compose("benchmark").pareto, resolve=True)
    for family in FAMILIES:
        found = find_settings(family, wanted[family]["base"], wanted[family]["knobs"])
        assert len(found) > 6
        assert [name for name in found if name != BASE and found[name] == found[BASE]] == []
    some = suite.find_families(wanted | {"knobs": ["bf16"]})
    assert some["feed_forward"].keys() == {BASE, "bf16"} and some["refined"].keys() == {BASE}
