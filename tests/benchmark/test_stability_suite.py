"""The stability suite is green, and a planted fault turns it red."""

import json
import math
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from einops import rearrange
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.models import head
from benchmarks.stability.comparison import StabilityCase, compare_to_reference, unit_roundoff
from benchmarks.stability.hostile import HOSTILE_GAUSSIANS
from benchmarks.stability.report import AREAS, measure, plot, tables, verdict

TINY = {"scale": "laptop", "width": 0.125, "state_size": 8, "model.layers": "1m1s"}
FEW = {
    "areas": ["renderer", "refinement"],
    "models": ["asysplat_4m4s"],
    "overrides": TINY,
    "views": [1, 8],
    "training_steps": 3,
    "refinement_steps": 3,
}


@pytest.fixture
def options(repository):
    """The options of conf/benchmark.yaml for a small run; networks can be composed."""
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        found = compose("benchmark", ["suite=stability"])
        OmegaConf.set_struct(found.stability, False)
        found.stability.merge_with(FEW)
        yield found


@pytest.fixture
def measured(options):
    def rows(area, *names):
        """Measure the fp32 cases of an area with these names."""
        cases = [case for case in AREAS[area](options.stability) if case.precision == "fp32"]
        found = [case.row() for case in cases if case.name.endswith(names)]
        assert len(found) == len(names)
        return found

    return rows


def cubed(tensors):
    return {"y": tensors["x"] ** 3}


def compare(fast):
    return compare_to_reference(fast, cubed, {"x": torch.rand(9) + 1}, ("x",))


def test_rounding_is_green_and_more_is_red():
    assert compare(cubed)["green"]
    for factor in (1 + 100 * unit_roundoff(torch.float32), 1 - 1e-3):
        assert not compare(lambda t: {"y": factor * cubed(t)["y"]})["green"]  # noqa: B023
    nearly = compare(lambda t: {"y": (1 + 4 * unit_roundoff(torch.float32)) * cubed(t)["y"]})
    assert nearly["green"] and nearly["error"] > unit_roundoff(torch.float32)
    assert nearly["tolerance"] < 1e-5


def test_a_difference_of_nearly_equal_numbers_has_a_larger_tolerance():
    inputs = {"x": torch.tensor([1.0, 2.0]), "z": torch.tensor([1.00001, 2.00002])}

    def difference(tensors):
        return {"y": tensors["x"] - tensors["z"]}

    row = compare_to_reference(difference, difference, inputs)
    assert row["green"] and row["tolerance"] > 0.05


@pytest.mark.parametrize("value, count", [(math.nan, "nan"), (math.inf, "inf")])
def test_non_finite_numbers_are_red_and_counted(value, count):
    row = compare(lambda t: {"y": cubed(t)["y"].where(torch.arange(9) < 7, value)})
    assert not row["green"] and row[count] == 2
    assert row["error"] is row["tolerance"] is None


@pytest.mark.medium
def test_a_small_page_is_green(options):
    results = {"machine": {"cpu": "some"}, **measure(options, Console(quiet=True))}
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert verdict(results) is None
    areas = [row["area"] for row in results["rows"]]
    assert list(dict.fromkeys(areas)) == FEW["areas"]
    assert areas.count("refinement") == len(HOSTILE_GAUSSIANS)
    for row in results["rows"]:
        assert row["green"], row
        assert row["area"] != "renderer" or 0 <= row["error"] <= row["tolerance"], row
    assert sum(table.row_count for table in tables(results)[1:]) == len(areas)
    assert plot(results).axes


def test_a_red_page_says_so_and_the_command_fails(tmp_path, run_script, monkeypatch):
    dark = StabilityCase("dark", "fp32", lambda: 1 / 0)
    monkeypatch.setitem(AREAS, "prior", lambda _: [dark])
    small = [f"output={tmp_path}", "stability.areas=[prior]"]
    done = run_script("benchmark.py", "suite=stability", *small)
    assert done.returncode == 1
    assert "red: 1 of 1 cases are not stable: prior: dark (fp32)" in done.stderr
    assert "raised ZeroDivisionError" in (tmp_path / "stability.md").read_text()
    assert json.loads((tmp_path / "stability.json").read_text())["rows"][0]["green"] is False


@pytest.mark.medium
def test_a_box_short_of_a_tile_is_red(measured, monkeypatch):
    """In the reference, which the kernels are compared with."""
    module = import_module("asysplat.rendering.reference.draw")
    list_tiles = module.list_tiles

    def fault(splats, images, height, width, size):
        return list_tiles(replace(splats, last=splats.last - size), images, height, width, size)

    monkeypatch.setattr(module, "list_tiles", fault)
    for row in measured("renderer", "Gaussians needles", "poses in a line", "views: 1"):
        assert not row["green"] and row["error"] > 1e-3 and row["nan"] == row["inf"] == 0


def nan_gradient(values, pattern, **sizes):
    """`rearrange` with correct values and NaN gradients."""
    values = values + 0 * (values - values.detach()).sqrt()
    return rearrange(values, pattern, **sizes)


@pytest.mark.medium
def test_a_nan_gradient_is_red(measured, monkeypatch):
    cases = [("network", "noise photographs"), ("training", "3 steps on hostile batches")]
    assert all(measured(*case)[0]["green"] for case in cases)
    monkeypatch.setattr(head, "rearrange", nan_gradient)
    for case in cases:
        (row,) = measured(*case)
        assert not row["green"] and row["nan"] > 0, case
