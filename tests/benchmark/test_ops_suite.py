"""The suite on operators of a moment."""

import math

import pytest

from asysplat.errors import InputError
from asysplat.runs.machine import find_device
from benchmarks.ops import PASSES, SCANS
from benchmarks.options import CPU, PRECISIONS, check_names

pytestmark = pytest.mark.medium

BOUNDS = {"fp32": 2e-6, "bf16": 1e-2}
PLANE_SWEEP_BOUND = 1e-5  # a pixel whose best two planes cost the same to the last bit may turn
LENGTH, LOOP_TOKENS = 150, 50
TINY = {
    "ssd": {"batch": 1, "length": LENGTH, "heads": 8, "head_dim": 16, "state": 8},
    "selective_scan": {"batch": 2, "length": LENGTH, "channels": 16, "state": 4},
    "grid_attention": {"batch": 1, "views": 2, "height": 4, "width": 6, "heads": 2, "head_dim": 8}
    | {"grids": [1, 2]},
    "plane_sweep": {"batch": 1, "views": 4, "height": 24, "width": 32}
    | {"planes": 20, "neighbors": 2},
    "loop_tokens": LOOP_TOKENS,
    "exact": {
        "ssd": {"length": 140},  # all heads: few numbers would make an error of A's gradient chance
        "selective_scan": {"batch": 1},
        "grid_attention": {"views": 1},
        "plane_sweep": {"views": 3},
    },
}
ATTENTION = ("grid_attention/1", "grid_attention/2")


@pytest.fixture(scope="module")
def rows(run_suite):
    """The rows by operator, precision and path."""
    results = run_suite("ops", {"ops": TINY})
    return {(row["operator"], row["precision"], row["path"]): row for row in results["rows"]}


def test_every_operator_has_all_paths(rows):
    for operator in (*SCANS, *ATTENTION):
        for precision in BOUNDS:
            paths = {path for name, p, path in rows if (name, p) == (operator, precision)}
            assert paths - {"loop"}
            assert ("loop" in paths) == (operator in SCANS and precision == "fp32")
    paths = {(precision, path) for name, precision, path in rows if name == "plane_sweep"}
    assert paths == {("fp32", path) for path in ("reference", "cpu")}


def test_errors_are_below_their_bounds_and_ratios_are_those_of_the_times(rows):
    for (operator, precision, path), row in rows.items():
        error, sweep = row["error"], operator == "plane_sweep"
        assert error["measured_on"] != row["sizes"]
        names = {"q", "k", "v"} if operator in ATTENTION else {"x", "dt", "A", "B", "C", "D"}
        gradients = {} if sweep else error["gradients"]
        assert error["gradients"] is None if sweep else gradients.keys() == names
        worst = max(error["forward"], *gradients.values(), 0)
        bound = PLANE_SWEEP_BOUND if sweep else BOUNDS[precision]
        assert 0 < worst < bound, (operator, precision, path)

        assert (row["forward_backward"] is None) == sweep
        loop = rows.get((operator, "fp32", "loop")) or rows.get((operator, "fp32", "reference"))
        assert bool(loop) == bool(row["faster_than_loop"])
        for name in (name for name in PASSES if row[name]):
            seconds = row[name]["median"]
            assert seconds > 0 and math.isfinite(row[name]["iqr"])
            if loop:
                expected = loop[name]["median"] / seconds
                assert row["faster_than_loop"][name] == pytest.approx(expected)
        assert path != "loop" or row["loop_tokens"] == LOOP_TOKENS


def test_unknown_options_are_named():
    with pytest.raises(InputError, match=r"^ops\.precisions=fp8 is unknown: .*fp32, bf16"):
        check_names("ops.precisions", ["fp32", "fp8"], PRECISIONS)
    with pytest.raises(InputError, match=r"^device=tpu is unknown: .*auto, cpu, cuda"):
        find_device("tpu")
    assert find_device("cpu") == CPU
