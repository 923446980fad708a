"""The suite on a network of a moment: its results are complete and consistent."""

import pytest
from hydra import initialize_config_dir

from asysplat.errors import InputError
from benchmarks.model import COMPONENTS, OPERATORS, OTHERS, make_net, tables
from benchmarks.options import CPU

TINY = {"scale": "laptop", "width": 0.125, "state_size": 8}


@pytest.mark.medium
@pytest.mark.parametrize("steps", [True, False])
def test_rows_are_complete_and_parts_are_those_of_the_model(run_suite, steps):
    layers = {"model.layers": "1m1s1t" if steps else "1m"}
    model = {"overrides": TINY | layers, "precisions": ["fp32"], "names": ["asysplat_4m4s"]}
    model |= {"views": [2], "scenes": 2, "checkpoint_layers": True, "steps": steps}
    results = run_suite("model", {"model": model, "repeats": 1})
    (row,) = results["rows"]
    assert row["model"] == "asysplat_4m4s" and row["parameters"] > 1e4
    assert (row["views"], row["scenes"], row["height"], row["width"]) == (2, 2, 64, 64)
    assert row["forward"]["median"] > 0
    assert (row["step"] is not None) == steps == (row["step_gb"] is not None)
    seconds = {name: part["seconds"]["median"] for name, part in row["components"].items()}
    assert min(seconds.values()) > 0
    if steps:
        assert set(seconds) == {*COMPONENTS, OTHERS} and set(row["operators"]) == set(OPERATORS)
        for operator, component in {"ssd": "Mamba2", "selective_scan": "MambaVision"}.items():
            assert row["operators"][operator]["median"] < seconds[component]
    else:
        assert not seconds.keys() & {"sparse attention", "full attention"}
    assert len(tables(results)) == 2


def test_unknown_overrides_are_named(repository):
    found = r"Could not find 'model.asysplat_4m4x': did you mean"
    with (
        initialize_config_dir(str(repository / "conf"), version_base=None),
        pytest.raises(InputError, match=found),
    ):
        make_net("asysplat_4m4x", TINY, CPU)
