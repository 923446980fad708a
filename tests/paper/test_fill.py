"""Our numbers in the paper's tables: costs of every row, and runs matched by configuration."""

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from asysplat.evaluation import static_cost
from asysplat.runs.machine import revision
from asysplat.runs.runs import describe_run, find_run
from asysplat.runs.stages import stage_configs
from paper.compare import check_costs, fits
from paper.fill import fill_table, finished_runs, with_costs
from paper.markdown import render_markdown
from paper.tables import find_tables, load_paper

OVERRIDES = ["steps=7"]


def write_run(folder: Path, config, numbers: dict, seed: int) -> None:
    folder.mkdir(parents=True)
    del config.hydra
    config.seed = seed
    (folder / "metrics.json").write_text(json.dumps(describe_run(config) | numbers))


# Tables of other sizes of the same networks.
SIZES = ("more_views", "mamba_ratio", "geometry_ratio")
TABLES = [pytest.param(key, marks=pytest.mark.slow if key in SIZES else ()) for key in load_paper()]


@pytest.mark.medium
@pytest.mark.parametrize("table", TABLES)
def test_costs_of_every_row_are_the_papers_or_flagged(compose, table, monkeypatch):
    # The paper prints no activations, and counting them is slow.
    monkeypatch.setattr(static_cost, "activation_gb", lambda *_: 0.0)
    filled = with_costs(load_paper()[table], compose)
    for row in filled.rows:
        if row.quoted or row.post_optimization:
            continue
        if row.unverified:
            # One of the readings has the paper's costs.
            assert len(row.reading_costs) == len(row.readings) > 0
            assert check_costs(row).startswith("unverified")
            assert any(fits(row, costs) for costs in (row.costs, *row.reading_costs))
        else:
            assert check_costs(row) in ("fits", "not printed")


@pytest.fixture
def logs(compose, tmp_path):
    for seed, psnr in ((0, 20.0), (2, 21.0)):
        config = compose(["sweeps=layers", "model=asysplat_7m1t", *OVERRIDES])
        numbers = {"test/procedural/psnr": psnr, "baseline/procedural/mean_color/psnr": 13.0}
        numbers["baseline/procedural/nearest_view/psnr"] = 16.0
        write_run(tmp_path / "a" / str(seed), config, numbers, seed)
    other = compose(["sweeps=layers", "model=asysplat_7m1t", "steps=8"])
    write_run(tmp_path / "b" / "0", other, {"test/procedural/psnr": 1.0}, 0)
    return tmp_path


def test_a_row_has_the_runs_of_its_configuration_and_no_others(compose, logs):
    (table,) = find_tables("layers")
    filled = fill_table(table, OVERRIDES, compose, finished_runs(logs))
    rows = {row.run: row for row in filled.rows}
    row = rows[("model=asysplat_7m1t",)]
    assert row.values["dl3dv/psnr"] == [20.0, 21.0]
    assert row.seeds == (0, 2) and row.note == "seeds still to run: 1"
    assert not rows[("model=asysplat_8t",)].values
    baselines = "procedural: mean color 13.00 dB, nearest view, copied 16.00 dB"
    assert filled.notes["Baselines"] == baselines
    assert filled.notes["Command"] == "python train.py sweeps=layers steps=7"


@pytest.mark.medium
def test_a_sweep_over_one_option_fills_its_table(compose, tmp_path):
    """python train.py -m geometry_ratio=0.5,0.9, without `sweeps=geometry_ratio`."""
    for ratio in (0.5, 0.9):
        config = compose([f"geometry_ratio={ratio}", *OVERRIDES])
        write_run(tmp_path / str(ratio), config, {"test/procedural/psnr": 20 + ratio}, 0)
    (table,) = find_tables("geometry_ratio")
    runs = finished_runs(tmp_path)
    rows = {row.name: row for row in fill_table(table, OVERRIDES, compose, runs).rows}
    assert {name: row.values["dl3dv/psnr"] for name, row in rows.items() if row.values} == {
        "50%": [20.5],
        "90%": [20.9],
    }
    assert rows["50%"].note.startswith("runs with geometry_ratio=0.5 parameter_budget=1.0")
    assert rows["50%"].note.endswith("seeds still to run: 1, 2")
    # Other steps are another table.
    assert not any(row.values for row in fill_table(table, ["steps=8"], compose, runs).rows)


@pytest.mark.medium
def test_a_row_without_a_run_names_the_one_most_like_it(compose, tmp_path):
    config = compose(["geometry_ratio=0.5", "steps=8"])
    write_run(tmp_path / "ratio", config, {"test/procedural/psnr": 20.0}, 0)
    config.paths.run = str(tmp_path / "ratio")
    OmegaConf.save(config, tmp_path / "ratio" / "config.yaml", resolve=True)
    (table,) = find_tables("geometry_ratio")
    rows = fill_table(table, OVERRIDES, compose, finished_runs(tmp_path)).rows
    row = next(row for row in rows if row.name == "50%")
    assert row.note.startswith(f"not run: {tmp_path / 'ratio'} has other options than the row")
    assert row.options[0] == "steps=8 (7)" and "parameter_budget=1.0 (0.98)" in row.options
    (table,) = find_tables("layers")
    rows = fill_table(table, ["scale=paper"], compose, finished_runs(tmp_path)).rows
    assert not any(row.note for row in rows)  # they differ in too much


@pytest.mark.medium
def test_one_run_fills_every_table_with_its_configuration(compose, logs, tmp_path):
    config = compose(["sweeps=layers", "model=asysplat_4m4s"])
    numbers = {"test/procedural/psnr": 20.0, "test/outdoors/psnr": 19.0}
    write_run(tmp_path / "c", config, numbers, 0)
    runs = finished_runs(tmp_path)
    for key in ("layers", "architecture", "asymmetry", "matched_parameters", "geometry_ratio"):
        filled = fill_table(load_paper()[key], [], compose, runs)
        ours = [row for row in filled.rows if row.values]
        assert [row.values["dl3dv/psnr"] for row in ours] == [[20.0]]
    assert ours[0].values["mipnerf360/psnr"] == [19.0]


DL3DV = ["data=dl3dv", "data.root=/a/DL3DV", "data.test_root=/a/Benchmark"]


@pytest.mark.medium
def test_runs_on_the_papers_data(compose, tmp_path):
    """They are found without their paths; a test set without a path has no numbers."""
    config = compose(
        ["sweeps=geometry_ratio", "model=asysplat_4m4s", *DL3DV, "paths.mipnerf360=/a/360_v2"]
    )
    numbers = {"test/dl3dv/psnr": 19.0, "test/mipnerf360/psnr": 17.0, "protocol/name": "longlrm"}
    numbers |= {"protocol/psnr": "of each image", "protocol/absrel": "of depths"}  # not printed
    numbers |= {"missing/ssim": "not measured, as"}
    write_run(tmp_path / "run", config, numbers, 0)
    runs = finished_runs(tmp_path)
    filled = fill_table(load_paper()["geometry_ratio"], ["data=dl3dv"], compose, runs)
    assert filled.rows[0].values == {"dl3dv/psnr": [19.0], "mipnerf360/psnr": [17.0]}
    assert filled.sets == {"dl3dv": "dl3dv", "mipnerf360": "mipnerf360"}
    assert filled.metrics == ("protocol longlrm. PSNR: of each image. SSIM: not measured, as",)
    assert filled.notes["Data"] == "DL3DV and Benchmark"
    assert filled.rows[0].revisions == (revision(),)
    assert filled.notes["Not tested"] == ""

    filled = fill_table(load_paper()["mamba_ratio"], ["data=dl3dv"], compose, {})
    untested = "MipNeRF-360, without paths.mipnerf360=...; ScanNet++, without paths.scannetpp=..."
    assert filled.notes["Not tested"] == untested
    assert filled.metrics == ("protocol longlrm",)
    other = ["data=dl3dv", "data.root=/a/DL3DV-small"]
    assert not fill_table(load_paper()["layers"], other, compose, runs).rows[0].values
    moved = ["data=dl3dv", "data.root=/b/c/DL3DV"]
    assert fill_table(load_paper()["layers"], moved, compose, runs).rows[0].values


@pytest.mark.medium
def test_a_run_that_was_tested_on_all_sets_comes_first(compose, tmp_path):
    paths = ["paths.mipnerf360=/a/360_v2"]
    every = compose(["sweeps=geometry_ratio", "model=asysplat_4m4s", *DL3DV, *paths])
    write_run(tmp_path / "a", every, {"test/dl3dv/psnr": 1.0, "test/mipnerf360/psnr": 2.0}, 0)
    write_run(
        tmp_path / "b",
        compose(["sweeps=layers", "model=asysplat_4m4s", *DL3DV]),
        {"test/dl3dv/psnr": 3.0},
        0,
    )
    runs = finished_runs(tmp_path)

    def first_row(key, *more):
        return fill_table(load_paper()[key], [*DL3DV, *more], compose, runs).rows[0].values

    assert first_row("geometry_ratio", *paths) == {"dl3dv/psnr": [1.0], "mipnerf360/psnr": [2.0]}
    assert first_row("layers") == {"dl3dv/psnr": [3.0]}


@pytest.mark.medium
def test_a_row_of_a_further_test_set_has_its_costs(compose, tmp_path):
    costs = {"cost/inference_seconds": 0.5, "cost/more_views/inference_seconds": 0.9}
    config = compose(["sweeps=more_views", "model=asysplat_4m4s"])
    write_run(tmp_path / "run", config, costs | {"test/more_views/psnr": 18.0}, 0)
    filled = fill_table(load_paper()["more_views"], [], compose, finished_runs(tmp_path))
    ours = [row.values for row in filled.rows if not row.quoted]
    assert [values["inference_seconds"] for values in ours] == [[0.5], [0.9]]
    assert [values.get("dl3dv/psnr") for values in ours] == [None, [18.0]]


@pytest.mark.medium
def test_tables_of_three_stages_share_their_runs_and_name_every_stage(compose, tmp_path):
    config = compose(["sweeps=state_of_the_art", "model=asysplat_4m4s"])
    write_run(tmp_path / "run", config, {"test/rooms/psnr": 20.0, "cost/inference_gb": 0.5}, 0)
    runs = finished_runs(tmp_path)
    columns = {"replica": "replica/psnr", "inference_overhead": "inference_gb"}
    for key, column in columns.items():
        filled = fill_table(load_paper()[key], [], compose, runs)
        assert [column in row.values for row in filled.rows].count(True) == 1
    scale = fill_table(load_paper()["two_views"], [], compose, runs).notes["Ours"]
    assert "2 input views of 64x64, " in scale
    scale = fill_table(load_paper()["replica"], [], compose, runs).notes["Ours"]
    sizes = [f"{stage.data.height}x{stage.data.width}" for stage in stage_configs(config)]
    assert [words.split(" at ")[1] for words in scale.split(", then ")][:2] == sizes[:2]
    assert sizes[0] != sizes[1]


@pytest.mark.medium
def test_claims_are_of_the_numbers_of_the_tables(compose, tmp_path, monkeypatch):
    monkeypatch.setattr(static_cost, "activation_gb", lambda *_: 0.0)
    for model, seconds in (("asysplat_4m4s", 2.0), ("longlrm", 4.0)):
        for stage in ("stage1", "stage2", "stage3"):
            config = compose(["sweeps=training_overhead", f"model={model}", f"stage={stage}"])
            write_run(tmp_path / model / stage, config, {"cost/seconds_per_step": seconds}, 0)
    (claims,) = find_tables("claims")
    filled = fill_table(claims, [], compose, finished_runs(tmp_path))
    text = render_markdown([with_costs(filled, compose)])
    ours = {}
    for line in text.splitlines():
        if line.startswith("| "):
            name, paper, number, numbers = line.strip("| ").split(" | ")
            ours[name] = paper, number, numbers
    # 240, 80 and 80 steps of 2 or 4 seconds at laptop scale.
    assert ours["training time by 30%"] == ("29.0%", "50.0%", "Stage (h): 0.222 / 0.444")
    assert ours["parameters by 30%"] == ("31.0%", "30.9%", "Param (M): 98.1 / 141.9")
    true = ours["ours: with attention products, scans and depthwise convolutions"]
    assert true == ("-", "58.0%", "True GFLOPs: 55,338 / 131,685")
    faster = ours["nearly 800x faster inference than 3DGS"]
    assert faster == ("over 780x", "not measured", "Time (s)")
    gain = ours["surpasses LongLRM by nearly 0.7 PSNR in a single feed-forward pass"]
    assert gain == ("+0.66", "not measured", "PSNR")
    assert "not counted" in render_markdown([filled])


@pytest.mark.medium
def test_post_optimization_is_not_run_until_evaluation_adds_it(compose, tmp_path):
    config = compose(["sweeps=state_of_the_art", "model=asysplat_4m4s"])
    write_run(tmp_path / "run", config, {"test/procedural/psnr": 20.0}, 0)
    table = load_paper()["state_of_the_art"]

    def ours():
        filled = fill_table(table, [], compose, finished_runs(tmp_path))
        return {row.post_optimization: row for row in filled.rows if "AsySplat" in row.name}

    assert ours()[0].values["dl3dv/psnr"] == [20.0]
    assert not ours()[10].values and "evaluate.py" in ours()[10].note
    added = {"test/procedural/post10/psnr": 23.0, "cost/post10/seconds": 4.0}
    (tmp_path / "run" / "evaluation.json").write_text(json.dumps(added))
    assert ours()[10].values["dl3dv/psnr"] == [23.0]
    assert ours()[10].values["inference_seconds"] == [4.0]
    assert not ours()[3].values


def test_broken_results_are_ignored(compose, tmp_path):
    config = compose(["sweeps=layers", "model=asysplat_4m4s"])
    write_run(tmp_path / "run", config, {"test/procedural/psnr": 20.0}, 0)
    config.seed = 0
    assert find_run(tmp_path, config).folder == tmp_path / "run"
    (tmp_path / "run" / "metrics.json").write_text('{"test/procedural/psnr": 1}')
    with pytest.warns(UserWarning, match="is not the results of a finished run"):
        assert find_run(tmp_path, config) is None
