"""The suite on networks of a moment: its results are complete and consistent."""

from collections import Counter
from dataclasses import replace

import pytest
import torch
from hydra import initialize_config_dir

from asysplat.benchmark import model as suite
from asysplat.benchmark.model import (
    COMPONENTS,
    NETWORKS,
    OPERATORS,
    OTHERS,
    Workload,
    make_net,
    make_views,
    record_products,
    tables,
)
from asysplat.benchmark.options import CPU
from asysplat.errors import InputError
from asysplat.evaluation.cost import true_flops
from asysplat.evaluation.static_cost import blank_views

pytestmark = pytest.mark.medium

OVERRIDES = {"scale": "laptop", "width": 0.125, "state_size": 8}
NAMES, VIEWS = ["asysplat_4m4t", "asysplat_4m4s"], [4, 8]
ATTENTION = dict(zip(NAMES, ("full attention", "sparse attention"), strict=True))


@pytest.fixture(scope="module")
def conf(repository):
    """Where models are composed from, as in benchmark.py."""
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        yield


@pytest.fixture(scope="module")
def run_model(run_suite):
    tiny = {"overrides": OVERRIDES, "precisions": ["fp32"]}
    return lambda **model: run_suite("model", {"model": tiny | model})


@pytest.fixture(scope="module")
def measured(run_model):
    """All results, and their rows by model and views."""
    results = run_model(names=NAMES, views=VIEWS)
    return results, {(row["model"], row["views"]): row for row in results["rows"]}


@pytest.fixture
def workload(conf):
    """A network and two views."""
    net, _ = make_net("asysplat_4m4s", OVERRIDES, CPU)
    return Workload("asysplat_4m4s", net, "bf16", make_views(2, 32, 64, CPU))


def test_rows_are_complete_and_consistent(measured):
    results, rows = measured
    assert set(rows) == {(name, views) for name in NAMES for views in VIEWS}
    for row in rows.values():
        assert (row["height"], row["width"]) == (64, 64)
        assert row["parameters"] > 1e5
        passes = {"forward": row["forward"], "step": row["step"]}
        floors = {"forward": row["floor"]["median"], "step": 3 * row["floor"]["median"]}
        for key, seconds in passes.items():
            assert seconds["iqr"] >= 0
            assert row["over_floor"][key] == pytest.approx(seconds["median"] / floors[key])
        assert row["peak_gb"]["step"] > row["peak_gb"]["forward"]
        assert NETWORKS["step\nGB"](row) == f"{row['peak_gb']['step']:.2f}"
        assert 0 < row["floor"]["median"] < row["forward"]["median"]
        assert all(part["floor"] >= 0 for part in row["components"].values())
    assert len(tables(results)) == 2


def test_steps_are_optional(run_model):
    for row in run_model(names=NAMES[:1], views=[2], steps=False)["rows"]:
        assert row["step"] is None and row["over_floor"]["step"] is None
        assert set(row["peak_gb"]) == {"forward"} and NETWORKS["step\nGB"](row) == "-"


def test_components_are_those_of_the_model(measured):
    for (name, _), row in measured[1].items():
        missing = set(ATTENTION.values()) - {ATTENTION[name]}
        assert set(row["components"]) == {*COMPONENTS, OTHERS} - missing
        assert set(row["operators"]) == set(OPERATORS)
        assert all(part["seconds"]["median"] > 0 for part in row["components"].values())
        scans = {"ssd": "Mamba2", "selective_scan": "MambaVision"}
        for operator, component in scans.items():
            within = row["components"][component]["seconds"]["median"]
            assert row["operators"][operator]["median"] < within


def test_products_are_those_that_torch_counts(measured, conf):
    for (name, views), row in measured[1].items():
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
    monkeypatch.setattr(suite, "memory_gb", lambda device: workload.step_gb / 2)
    assert not workload.step_fits


def test_unknown_overrides_are_named(conf):
    with pytest.raises(InputError, match=r"^model=asysplat_4m4x is unknown: .*asysplat_4m4"):
        make_net("asysplat_4m4x", OVERRIDES, CPU)
    with pytest.raises(InputError, match=r"^scale=desk is unknown"):
        make_net("asysplat_4m4s", {"scale": "desk"}, CPU)
