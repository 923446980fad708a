"""The suite on a small scene: its results are complete, and are those of its parts."""

import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import Progress

from asysplat import load
from asysplat.errors import InputError
from asysplat.evaluation.measured_cost import memory_gb, reset_peak_memory
from asysplat.evaluation.metrics import psnr
from asysplat.rendering import render
from benchmarks import pareto
from benchmarks.data import write_photographs
from benchmarks.pareto import (
    BASE,
    FAMILIES,
    average_scenes,
    find_families,
    find_scenes,
    plot,
    select_inputs,
    tables,
)

SIDE = 32
VARIANTS = {
    "feed_forward": {
        "bf16": {"precision": "bf16"},
        "side_16": {"side": 16},
        "fewer": {"min_opacity": 0.2, "max_gaussians": 500, "sh_degree": 0, "views_at_once": 1},
        "side_24": {"side": 24},  # which the network cannot take
    },
    "networks": {"8m": {"overrides": ["model.layers=1m", "width=0.125", "state_size=8"]}},
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


@pytest.fixture(scope="module")
def measured(make_pareto, run_suite):
    options = make_pareto()
    return options, run_suite("pareto", options)


@pytest.mark.medium
def test_rows_are_complete_and_absences_are_named(measured):
    options, results = measured
    config = OmegaConf.to_container(options.pareto, resolve=True)
    rows = {(row["family"], row["setting"]): row for row in results["rows"]}
    assert list(rows) == [
        (f, name) for f, variants in VARIANTS.items() for name in (BASE, *variants)
    ]
    for (family, name), row in rows.items():
        assert (row["scene"], row["side"]) == ("room", SIDE)
        wanted = config[family]["base"] | config[family]["variants"].get(name, {})
        assert {key: row["values"][key] for key in wanted} == wanted
        if name in ABSENT:
            assert ABSENT[name] in row["not_measured"]
            assert {row[key] for key in ("seconds", "over_base", "psnr")} == {None}
            continue
        assert row["not_measured"] is None and row["lpips"] is None
        assert row["seconds"]["median"] > 0
        if reset_peak_memory("cpu"):
            assert 0.1 < row["peak_gb"] < memory_gb("cpu")
        assert name != BASE or row["over_base"]["median"] == 1
        assert (family == "reconstruct") == ("noise" in row)
        assert (row["psnr"] is None) == (family == "networks")
        assert (row["error"] is None) == (name == BASE and family in ("refined", "reconstruct"))
    absent = results["not_measured"]
    assert absent["fern"].endswith("is no folder") and "weights" in absent["LPIPS"]
    assert "feed_forward, room, side_24" in absent
    assert ("a GPU" in absent) != torch.cuda.is_available()
    assert "not measured: fern, " in tables(results)[-1].caption


@pytest.mark.medium
def test_errors_grow_with_what_is_left_out(measured):
    _, results = measured
    errors = {(r["family"], r["setting"]): r["error"] for r in results["rows"] if r["error"]}
    decibels = {name: error["decibels"] for name, error in errors.items()}
    base, bf16, side = (decibels["feed_forward", name] for name in (BASE, "bf16", "side_16"))
    assert base > 70 and base > bf16 > side > 10
    # Other layers are compared with their own float64, not with the base's.
    assert min(decibels["networks", BASE], decibels["networks", "8m"]) > 70


@pytest.mark.medium
def test_a_row_is_what_the_network_and_the_renderer_give(measured, tmp_path):
    row = measured[1]["rows"][0]
    scenes, _ = find_scenes(["room"], tmp_path)
    room = scenes["room"](SIDE, 16, 4)
    scene = select_inputs(room, 3, SIDE)
    assert scene.inputs.num_views == 3 and room.inputs.num_views > 3
    with torch.no_grad():
        gaussians, background = load()(scene.inputs), scene.inputs.mean_color()
        image = render(gaussians, scene.held_out.cameras, background, depth=False).image
    assert row["gaussians"] == gaussians.num_gaussians
    assert row["psnr"] == pytest.approx(psnr(image, scene.held_out.images).mean().item(), abs=1e-4)


@pytest.mark.medium
@pytest.mark.parametrize("family", ["refined", "reconstruct"])
def test_the_bar_ends_with_the_last_run(make_pareto, monkeypatch, family):
    bars = []
    monkeypatch.setattr(pareto, "Progress", lambda **how: bars.append(Progress(**how)) or bars[0])
    options = make_pareto(families=[family], scenes=["room"])
    options.pareto[family].variants = {"start": {"seconds": None, "steps": 0}}
    pareto.measure(options, Console(quiet=True))
    assert bars[0].finished


def test_a_folder_of_photographs_is_a_scene(tmp_path):
    write_photographs(tmp_path / "mine", 12, 40, 60)
    scenes, absent = find_scenes(["mine", "fox"], tmp_path)
    scene = scenes["mine"](SIDE, 16, 4)
    assert absent.keys() == {"fox"} and scene.name == "mine"
    assert (scene.inputs.num_views, scene.held_out.num_views) == (10, 2)
    assert scene.inputs.images.shape[-2:] == (SIDE, SIDE)


def make_row(family, scene, setting, seconds, psnr=None, error=None, busy=False):
    row = {"family": family, "scene": scene, "setting": setting, "not_measured": None}
    row |= {"psnr": psnr, "lpips": None, "error": error and {"decibels": error}}
    timed = seconds and {"median": seconds, "iqr": 0.0, "busy": busy}
    over = seconds and {"median": seconds / 4.0, "iqr": 0.0, "busy": False}
    return row | {"seconds": timed, "over_base": over}


MADE_ROWS = [
    make_row("refined", "a", BASE, 4.0, 30.0),
    make_row("refined", "b", BASE, 4.0, 20.0),
    make_row("refined", "a", "quick", 1.0, 29.0, 40.0),
    make_row("refined", "b", "quick", 4.0, 19.5, 30.0, busy=True),
    make_row("refined", "a", "slow", 8.0, 25.0),
    make_row("refined", "b", "slow", 8.0, 25.0),
    make_row("refined", "a", "absent", None),
    make_row("networks", "a", BASE, 4.0, error=90.0),
    make_row("networks", "a", "other", 3.0, error=80.0),
    make_row("networks", "a", "worse", 3.5, error=70.0),
]


def test_means_are_over_scenes():
    means = {(row["family"], row["setting"]): row for row in average_scenes(MADE_ROWS)}
    quick = means["refined", "quick"]
    assert (quick["scenes"], quick["seconds"], quick["psnr"]) == (2, 2.5, 24.25)
    assert quick["over_base"] == pytest.approx(0.5)
    assert (quick["lost"], quick["error"]) == (0.75, 35.0)
    assert quick["busy"] and not means["refined", BASE]["busy"]
    absent = means["refined", "absent"]
    assert absent["scenes"] == 0 and absent["seconds"] is absent["psnr"] is absent["lost"] is None


def test_tables_and_figure_have_every_setting():
    results = {"machine": {"cpu": "one"}, "rows": MADE_ROWS, "not_measured": {}}
    shown = tables(results)
    assert [len(table.rows) for table in shown] == [4, 3, 3, 4, 3]
    cells = {row[0]: row for row in zip(*(c.cells for c in shown[3].columns), strict=True)}
    assert "busy" in cells["quick"]
    assert "-" in cells["absent"] and "0" not in cells["absent"][3:]
    figure = plot(results)
    panels = {(axes.get_title(), axes.get_ylabel()): axes for axes in figure.axes}
    of_refined = panels["Refined", pareto.QUALITIES["psnr"]]
    assert {text.get_text() for text in of_refined.texts} == {BASE, "quick", "slow"}
    line, *_ = of_refined.lines
    assert list(line.get_xdata()) == [2.5, 4.0] and list(line.get_ydata()) == [24.25, 25.0]


def variant(family, **changes):
    return {family: {"variants": {"a": changes}}}


MISTAKES = [
    ({"families": ["refine"]}, r"^pareto\.families=refine is unknown: choose from "),
    ({"variants": ["bf61"]}, r"^pareto\.variants=bf61 is unknown: choose from base, bf16, "),
    ({"scenes": ["ferns"]}, r"^pareto\.scenes=ferns is unknown: choose from room, "),
    ({"scenes": ["fern"]}, r"^pareto\.scenes=\['fern'\]: none is a folder of"),
    ({"refined": {"variants": {"a": 3}}}, r"^pareto\.refined\.a=3 is no setting"),
    (
        variant("feed_forward", precison="bf16"),
        r"feed_forward\.a=precison is unknown: choose from v",
    ),
    (
        variant("feed_forward", precision="fp8"),
        r"feed_forward\.a: precision=fp8 is unknown: choose",
    ),
    (variant("feed_forward", overrides=["model.layers=8m"]), "not fit this model"),
    (
        variant("feed_forward", overrides=["model.layer=8m"]),
        r"^Could not override .model\.layer.: did you mean",
    ),
    (variant("refined", views=0), r"refined\.a: views=0: give a whole number from 1\."),
    (
        variant("refined", refinement={"half_resolution_until": 2.0}),
        r"^refinement\.half_resolution_until=2\.0 should be less than or equal to 1",
    ),
    (variant("reconstruct", init="dust"), r"reconstruct\.a: init=dust is unknown: choose from"),
    (variant("reconstruct", seconds=0), r"steps=None and seconds=0: give one of them, above 0\."),
]


@pytest.mark.medium
@pytest.mark.parametrize("changes, sentence", MISTAKES)
def test_mistakes_are_named(make_pareto, changes, sentence):
    with pytest.raises(InputError, match=sentence) as raised:
        pareto.measure(make_pareto(**changes), Console(quiet=True))
    assert "\n" not in str(raised.value)


def test_every_variant_of_the_configuration_is_a_setting(make_options):
    config = OmegaConf.to_container(make_options("pareto", {}).pareto, resolve=True)
    for family, settings in find_families(config | {"families": list(FAMILIES)}).items():
        assert len(settings) > 1
        same = [name for name in settings if settings[name] == settings[BASE]]
        assert same == [BASE], family
    some = find_families(config | {"variants": ["bf16"]})
    assert some["feed_forward"].keys() == {BASE, "bf16"} and some["refined"].keys() == {BASE}
