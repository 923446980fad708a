"""train.py on tiny synthetic scenes: what a run leaves, and which mistakes it refuses."""

import csv
import json
import math
from pathlib import Path

import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tiny_runs import COSTS, finished


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_a_run_leaves_metrics_figures_curves_and_checkpoints(whole):
    folder, numbers = whole, metrics(whole)
    for name in ("psnr", "ssim", "absrel", "delta1"):
        assert isinstance(numbers[f"test/procedural/{name}"], float)
    assert numbers["baseline/procedural/mean_color/psnr"] < 30
    assert numbers["baseline/procedural/nearest_view/psnr"] < 30
    expected = {"parameters", "geometry_ratio", "gflops", "gflops_true", "gaussians"}
    expected |= {"peak_gb", "seconds_per_step"}
    tests = ("inference", "rooms/inference", "outdoors/inference")
    expected |= {f"{test}_{unit}" for test in tests for unit in ("seconds", "gb")}
    assert expected <= {key.removeprefix("cost/") for key in numbers if key.startswith("cost/")}
    assert "window 11x11" in numbers["protocol/ssim"] and numbers["protocol/name"] == "default"
    assert "all measurements but the longest" in numbers["protocol/seconds"]
    assert numbers["cost/gaussians"] == 3 * 16 * 16
    assert numbers["cost/gflops_true"] > numbers["cost/gflops"] > 0

    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert next(iter(rows[0])) == "set" and len(rows) == 3 * 2 * 2
    for name in ("procedural", "rooms", "outdoors"):
        values = [float(row["psnr"]) for row in rows if row["set"] == name]
        assert len(values) == 2 * 2
        assert abs(sum(values) / len(values) - numbers[f"test/{name}/psnr"]) < 1e-4

    assert yaml.safe_load((folder / "config.yaml").read_text())["steps"] == 6
    assert {"best.ckpt", "last.ckpt"} <= {p.name for p in (folder / "checkpoints").iterdir()}
    assert (folder / "figures" / "test-0.png").stat().st_size > 10_000
    with (folder / "curve.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["0", "2", "4", "6"]
    assert (folder / "figures" / "curve.png").stat().st_size > 5_000


def test_tensorboard_has_what_a_run_measures(whole):
    events = EventAccumulator(str(whole / "tensorboard"), size_guidance={"histograms": 0}).Reload()
    names = ("train/psnr", "val/psnr", "test/procedural/psnr", "train/learning_rate")
    names += ("cost/parameters", "baseline/procedural/mean_color/psnr")
    assert {*names} <= set(events.Tags()["scalars"])
    for name in ("time/views_per_second", "gradient/geometry", "gradient/head", "memory/peak_gb"):
        assert [event.step for event in events.Scalars(name)] == [1, 3, 5]

    # Every validation has histograms of its Gaussians.
    assert set(events.Tags()["histograms"]) == {
        f"gaussians/{name}" for name in ("opacity", "log10_scale", "log10_depth")
    }
    counted = events.Histograms("gaussians/opacity")
    assert [event.step for event in counted] == [0, 2, 4, 6]
    assert counted[-1].histogram_value.num == metrics(whole)["cost/gaussians"]
    assert 0 < events.Scalars("gaussians/opacity_median")[-1].value < 1
    assert any(tag.startswith("val/") for tag in events.Tags()["images"])

    layout = events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0]
    (category,) = Layout.FromString(layout).category
    charts = {chart.title: [*chart.multiline.tag] for chart in category.chart}
    assert charts["PSNR (dB)"] == ["val/psnr", "train/psnr"] and charts["AbsRel"] == ["val/absrel"]
    assert {tag for tags in charts.values() for tag in tags} <= set(events.Tags()["scalars"])


def test_without_its_weights_lpips_is_missing_and_not_zero(train, tmp_path, monkeypatch):
    """The table says why, and the hparams tab has no initial value, as 0 is the best possible."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    result = train("steps=1", f"paths.weights={tmp_path}", "~callbacks.figures")
    folder = finished(result)
    table, _, rest = result.stdout.rpartition("LPIPS: not measured, as AlexNet is neither in ")
    assert "LPIPS" in table.rpartition("test scenes")[2] and "paths.download=true" in rest
    numbers = metrics(folder)
    events = EventAccumulator(str(folder / "tensorboard")).Reload()
    experiment = events.PluginTagToContent("hparams")["_hparams_/experiment"]
    listed = HParamsPluginData.FromString(experiment).experiment.metric_infos
    names = {"psnr", "ssim", "absrel", "delta1"}
    assert {info.name.tag for info in listed} == {f"hp/{name}" for name in names}
    assert {tag for tag in events.Tags()["scalars"] if tag.startswith("hp/")} == {
        f"hp/{name}" for name in names
    }
    for name in names:
        (event,) = events.Scalars(f"hp/{name}")
        assert abs(event.value - numbers[f"test/procedural/{name}"]) < 1e-3


LEFT_OUT = [
    ["metrics", "non_finite_steps", "figures"],
    ["costs", "curve", "checkpoints", "progress", "monitor"],
]


@pytest.mark.medium
@pytest.mark.parametrize("names", LEFT_OUT, ids=" ".join)
def test_without_some_callbacks_the_rest_is_there(train, names, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("ASYSPLAT_SHARED", str(tmp_path))
    logged = "monitor" not in names
    options = ["callbacks.monitor.every=2" if logged else "logger=none"]
    options += [COSTS] * ("costs" not in names)
    removed = ["callbacks.figures=null" if n == "figures" else f"~callbacks.{n}" for n in names]
    result = train(*removed, *options)
    folder = finished(result)
    numbers, checkpoints = metrics(folder), folder / "checkpoints"
    assert (folder / "tensorboard").exists() == logged
    left = {
        "metrics": (
            "test/procedural/psnr" in numbers,
            (folder / "metrics.csv").exists(),
        ),
        "costs": ("cost/parameters" in numbers, "plan: " in result.stdout),
        "figures": ((folder / "figures" / "test-0.png").exists(),),
        # The curve is drawn from what metrics measure.
        "curve": ((folder / "curve.csv").exists() or "metrics" in names,),
        "checkpoints": (
            (checkpoints / "last.ckpt").exists(),
            (checkpoints / "best.ckpt").exists() or "metrics" in names,
        ),
        "progress": ("step 2 of 4" in result.stdout,),
    }
    for name, there in left.items():
        assert set(there) == {name not in names}, name
    warning = "warning: LPIPS is not measured, as AlexNet is neither in torch's hub cache nor in"
    assert (warning in result.stderr) == ("metrics" not in names)
    assert not list(folder.glob("tensorboard/**/*.ckpt"))
    assert "Epoch" not in result.stdout + result.stderr


@pytest.mark.medium
def test_bfloat16_with_the_perceptual_term_and_a_protocol_by_name(train, shared):
    options = ["training.loss.perceptual=0.5", f"paths.shared={shared}", "metrics=longlrm"]
    result = train("trainer.precision=bf16-mixed", "steps=2", "model/head=residual", *options)
    folder = finished(result)
    numbers = metrics(folder)
    assert numbers["test/procedural/psnr"] > numbers["baseline/procedural/mean_color/psnr"]
    assert 0 < numbers["test/procedural/lpips"] < 1
    weights = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    assert not any("vgg" in name for name in weights)
    assert all(tensor.dtype != torch.bfloat16 for tensor in weights.values())
    assert numbers["protocol/name"] == "longlrm" and "metrics: longlrm" in result.stdout
    assert "uniform window 7x7" in numbers["protocol/ssim"]
    for name in ("psnr", "ssim", "lpips", "absrel", "delta1"):
        assert math.isfinite(numbers[f"test/procedural/{name}"])
        assert "over scenes" in numbers[f"protocol/{name}"]


@pytest.mark.medium
@pytest.mark.parametrize("name", ["fern", pytest.param("hololens-000", marks=pytest.mark.slow)])
def test_training_on_a_real_scene_leaves_its_files(train, shared, name):
    scene = shared / "data" / name
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    folder = finished(train("data=files", f"data.root={scene}"))
    assert metrics(folder)["test/files/psnr"] > 5
    assert ("test/files/absrel" in metrics(folder)) == (name == "hololens-000")
    assert {path: path.stat().st_mtime_ns for path in scene.rglob("*")} == before


REFUSED = {
    "one of a sweep": (["-m", "seed=-1,x"], "seed=x should be a valid integer."),
    "a trainer that cannot be": (["trainer.precision=bf17"], "error: trainer: Precision 'bf17' is"),
    "images too small to measure": (
        ["data.height=4", "data.width=4", "model.patch_coarse=4", "model.patch_fine=2"],
        "SSIM needs images of at least 11x11 pixels, these have 4x4",
    ),
}


@pytest.mark.medium
@pytest.mark.parametrize("case", REFUSED)
def test_a_mistake_is_one_sentence_and_status_1(train, case, tmp_path):
    overrides, message = REFUSED[case]
    result = train(*overrides)
    assert result.returncode == 1
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.rglob("checkpoints"))
    if case != "one of a sweep":  # whose table reads what Hydra wrote
        assert not list(tmp_path.iterdir())


@pytest.mark.medium
def test_a_checkpoint_of_another_model_is_refused(train, whole, tmp_path):
    path = whole / "checkpoints" / "last.ckpt"
    result = train("width=0.25", f"ckpt_path={path}")
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert f"{path} does not fit this model" in result.stderr
    assert not list(tmp_path.rglob("*.ckpt"))
