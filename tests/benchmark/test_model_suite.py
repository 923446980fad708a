"""The suite on a network of a moment: its results are complete and consistent."""

import pytest
from hydra import initialize_config_dir

from asysplat.errors import InputError
from benchmarks.model import COMPONENTS, OPERATORS, OTHERS, make_net, tables
from benchmarks.options import CPU

pytestmark = pytest.mark.medium

TINY = {"scale": "laptop", "width": 0.125, "state_size": 8}


@pytest.fixture(scope="module")
def run_model(run_suite):
    def run(layers, **model):
        overrides = TINY | {"model.layers": layers}
        model |= {"overrides": overrides, "precisions": ["fp32"], "names": ["asysplat_4m4s"]}
        return run_suite("model", {"model": model, "repeats": 1})

    return run


def test_rows_are_complete_and_parts_are_those_of_the_model(run_model):
    results = run_model("1m1s1t", views=[1, 2], scenes=2, checkpoint_layers=True)
    assert [row["views"] for row in results["rows"]] == [1, 2]
    for row in results["rows"]:
        assert row["model"] == "asysplat_4m4s" and row["parameters"] > 1e5
        assert (row["scenes"], row["height"], row["width"]) == (2, 64, 64)
        assert row["checkpointing"] and row["step_gb"] > 0.1
        assert all(row[key]["median"] > 0 and row[key]["iqr"] >= 0 for key in ("forward", "step"))
        seconds = {name: part["seconds"]["median"] for name, part in row["components"].items()}
        assert set(seconds) == {*COMPONENTS, OTHERS} and min(seconds.values()) > 0
        assert set(row["operators"]) == set(OPERATORS)
        for operator, component in {"ssd": "Mamba2", "selective_scan": "MambaVision"}.items():
            assert row["operators"][operator]["median"] < seconds[component]
    assert len(tables(results)) == 2


def test_steps_and_absent_parts_are_left_out(run_model):
    results = run_model("1m", views=[1], steps=False)
    (row,) = results["rows"]
    assert row["step"] is None
    assert [list(column.cells) for column in tables(results)[0].columns[-2:]] == [["-"], ["-"]]
    assert not row["components"].keys() & {"sparse attention", "full attention"}


def test_unknown_overrides_are_named(repository):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        with pytest.raises(InputError, match=r"Could not find 'model.asysplat_4m4x': did you mean"):
            make_net("asysplat_4m4x", TINY, CPU)
        with pytest.raises(InputError, match=r"Could not find 'scale.desk'"):
            make_net("asysplat_4m4s", {"scale": "desk"}, CPU)
