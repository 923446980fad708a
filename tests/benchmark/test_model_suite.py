"""The suite on networks of a moment: its results are complete and consistent."""

import pytest
from hydra import initialize_config_dir

from asysplat.benchmark.model import (
    COMPONENTS,
    OPERATORS,
    OTHERS,
    make_net,
    tables,
)
from asysplat.benchmark.options import CPU
from asysplat.errors import InputError

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


def test_rows_are_complete_and_consistent(measured):
    results, rows = measured
    assert set(rows) == {(name, views) for name in NAMES for views in VIEWS}
    for row in rows.values():
        assert (row["height"], row["width"]) == (64, 64)
        assert row["parameters"] > 1e5
        assert all(row[key]["median"] > 0 and row[key]["iqr"] >= 0 for key in ("forward", "step"))
    assert len(tables(results)) == 2


def test_steps_are_optional(run_model):
    results = run_model(names=NAMES[:1], views=[2], steps=False)
    assert results["rows"][0]["step"] is None
    assert list(tables(results)[0].columns[-1].cells) == ["-"]


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


def test_unknown_overrides_are_named(conf):
    with pytest.raises(InputError, match=r"^model=asysplat_4m4x is unknown: .*asysplat_4m4"):
        make_net("asysplat_4m4x", OVERRIDES, CPU)
    with pytest.raises(InputError, match=r"^scale=desk is unknown"):
        make_net("asysplat_4m4s", {"scale": "desk"}, CPU)
