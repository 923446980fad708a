"""The suite on networks of a moment: what it finds is complete and agrees with itself."""

import json
import math
import runpy
from collections import Counter
from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from asysplat.benchmark.model import workload as workloads
from asysplat.benchmark.model.components import COMPONENTS, OPERATORS, OTHERS, record_products
from asysplat.benchmark.model.suite import NETWORKS, tables
from asysplat.benchmark.model.workload import Workload, make_net, make_views
from asysplat.errors import InputError
from asysplat.evaluation.cost import true_flops
from asysplat.evaluation.static_cost import blank_views

pytestmark = pytest.mark.medium

CPU = torch.device("cpu")
OVERRIDES = {"scale": "laptop", "width": 0.125, "state_size": 8}
NAMES, VIEWS = ["asysplat_4m4t", "asysplat_4m4s"], [4, 8]
ATTENTION = dict(zip(NAMES, ("full attention", "sparse attention"), strict=True))


@pytest.fixture(scope="module")
def conf(repository):
    """Where models are composed from, as in benchmark.py."""
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        yield


@pytest.fixture(scope="module")
def run_suite(conf, repository, tmp_path_factory):
    """The suite on these options of `model`: its results and the folder they are in."""

    def run(**model):
        folder = tmp_path_factory.mktemp("benchmark")
        script = runpy.run_path(str(repository / "benchmark.py"))
        options = compose("benchmark", ["suite=model", "repeats=2", "device=cpu"])
        OmegaConf.set_struct(options, False)  # the overrides are the user's
        tiny = {"overrides": OVERRIDES, "precisions": ["fp32"], **model}
        script["benchmark"](OmegaConf.merge(options, {"model": tiny, "output": str(folder)}))
        return json.loads((folder / "model.json").read_text()), folder

    return run


@pytest.fixture(scope="module")
def measured(run_suite):
    """The numbers by model, views and precision, all of them, and the folder they are in."""
    results, folder = run_suite(names=NAMES, views=VIEWS)
    rows = {(row["model"], row["views"], row["precision"]): row for row in results["rows"]}
    return rows, results, folder


@pytest.fixture
def workload(conf):
    """A network and two views."""
    net, _ = make_net("asysplat_4m4s", OVERRIDES, CPU)
    return Workload("asysplat_4m4s", net, "bf16", make_views(2, 32, 64, CPU))


def test_rows_are_complete_and_consistent(measured):
    rows, results, folder = measured
    assert set(rows) == {(name, views, "fp32") for name in NAMES for views in VIEWS}
    for (name, views, precision), row in rows.items():
        assert (row["height"], row["width"], row["tokens"]) == (64, 64, 16 * views)
        assert row["parameters"] > 1e5
        passes = {"forward": row["forward"], "step": row["step"]}
        floors = {"forward": row["floor"]["median"], "step": 3 * row["floor"]["median"]}
        for key, seconds in passes.items():
            assert seconds["iqr"] >= 0
            assert row["over_floor"][key] == pytest.approx(seconds["median"] / floors[key])
            assert row["bytes_per_token"][key] * row["tokens"] == pytest.approx(
                1e9 * row["peak_gb"][key]
            )
            first = rows[NAMES[0], views, precision][key]["median"]
            assert row["over_first"][key] == pytest.approx(seconds["median"] / first)
            assert row["over_first"][key] == 1 or name != NAMES[0]
        assert row["peak_gb"]["step"] > row["peak_gb"]["forward"]
        kilobytes = f"{1e6 * row['peak_gb']['step'] / row['tokens']:,.0f}"
        assert NETWORKS["step\nkB / token"](row) == kilobytes
    assert len(tables(results)) == 3
    assert (folder / "model.png").stat().st_size > 0


def test_steps_are_left_out_where_they_are_not_asked_for(run_suite):
    results, _ = run_suite(names=NAMES[:1], views=[2], steps=False)
    for row in results["rows"]:
        assert row["step"] is None and row["over_floor"]["step"] is None
        assert row["over_first"]["step"] is None and row["over_first"]["forward"] > 0
        assert set(row["peak_gb"]) == {"forward"} and NETWORKS["step\nGB"](row) == "-"


def test_the_floor_is_below_the_total(measured):
    for row in measured[0].values():
        assert 0 < row["floor"]["median"] < row["forward"]["median"]
        assert all(part["floor"] >= 0 for part in row["components"].values())


def test_components_are_those_of_the_model(measured):
    for (name, _, _), row in measured[0].items():
        missing = set(ATTENTION.values()) - {ATTENTION[name]}
        assert set(row["components"]) == {*COMPONENTS, OTHERS} - missing
        assert set(row["operators"]) == set(OPERATORS)
        assert all(part["seconds"]["median"] > 0 for part in row["components"].values())
        scans = {"ssd": "Mamba2", "selective_scan": "MambaVision"}
        for operator, component in scans.items():
            within = row["components"][component]["seconds"]["median"]
            assert row["operators"][operator]["median"] < within


def test_products_add_up_to_what_torch_counts(measured, conf):
    for (name, views, _), row in measured[0].items():
        listed = sum(entry["count"] * entry["gflops"] for entry in row["products"])
        assert listed == pytest.approx(row["gflops"])
        assert all(math.isfinite(entry["seconds"]) for entry in row["products"])
        net, size = make_net(name, OVERRIDES, torch.device("meta"))
        with torch.device("meta"), torch.no_grad():
            inputs = blank_views(views, size["height"], size["width"])
            counted = true_flops(lambda net=net, inputs=inputs: net(inputs))
        assert row["gflops"] == pytest.approx(counted / 1e9, rel=0.01)


def test_products_have_the_precision_and_the_component_they_run_in(workload):
    counts = record_products(workload.forward)
    assert counts.pop("forward") == sum(counts.values(), Counter())
    assert counts.keys() == {*COMPONENTS, OTHERS} - {"full attention"}
    layers = [p for name, part in counts.items() if name != OTHERS for p in part]
    linears = [p for p in layers if p.function is torch.ops.aten.mm.default]
    assert linears and all(p.arguments[0].dtype == torch.bfloat16 for p in linears)
    convolutions = {n for n, part in counts.items() if any("convolution" in str(p) for p in part)}
    assert convolutions == {"Mamba2", "MambaVision", "sparse attention", OTHERS}


def test_hooks_and_gradients_are_taken_away_again(workload):
    record_products(workload.forward)
    workload.step()
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in workload.net.modules())
    assert all(parameter.grad is None for parameter in workload.net.parameters())
    assert not workload.forward().means.requires_grad


def test_a_step_that_does_not_fit_is_left_out(workload, monkeypatch):
    assert workload.step_fits and workload.step_gb > 0
    workload.forward()  # in evaluation mode, in which the network would keep less
    assert replace(workload).step_gb == workload.step_gb
    monkeypatch.setattr(workloads, "memory_gb", lambda device: workload.step_gb / 2)
    assert not workload.step_fits


def test_unknown_overrides_are_named(conf):
    with pytest.raises(InputError, match=r"^model=asysplat_4m4x is unknown: .*asysplat_4m4"):
        make_net("asysplat_4m4x", OVERRIDES, CPU)
    with pytest.raises(InputError, match=r"^scale=desk is unknown"):
        make_net("asysplat_4m4s", {"scale": "desk"}, CPU)
