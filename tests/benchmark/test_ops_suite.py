"""The suite on operators of a moment."""

import math

import pytest

from benchmarks.ops import PASSES, SCANS

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


@pytest.mark.medium
def test_errors_are_below_their_bounds_and_ratios_are_those_of_the_times(run_suite):
    results = run_suite("ops", {"ops": TINY})
    rows = {(row["operator"], row["precision"], row["path"]): row for row in results["rows"]}
    for operator in (*SCANS, *ATTENTION):
        for precision in BOUNDS:
            paths = {path for name, p, path in rows if (name, p) == (operator, precision)}
            assert paths - {"loop"}
            assert ("loop" in paths) == (operator in SCANS and precision == "fp32")
    paths = {(precision, path) for name, precision, path in rows if name == "plane_sweep"}
    assert paths == {("fp32", path) for path in ("reference", "cpu")}

    for (operator, precision, path), row in rows.items():
        error, sweep = row["error"], operator == "plane_sweep"
        assert error["measured_on"] != row["sizes"]
        assert (error["gradients"] is None) == (row["forward_backward"] is None) == sweep
        worst = max(error["forward"], *(error["gradients"] or {}).values(), 0)
        bound = PLANE_SWEEP_BOUND if sweep else BOUNDS[precision]
        assert 0 < worst < bound, (operator, precision, path)
        loop = rows.get((operator, "fp32", "loop")) or rows.get((operator, "fp32", "reference"))
        assert bool(loop) == bool(row["faster_than_loop"])
        for name in (name for name in PASSES if row[name]):
            seconds = row[name]["median"]
            assert seconds > 0 and math.isfinite(row[name]["iqr"])
            if loop:
                expected = loop[name]["median"] / seconds
                assert row["faster_than_loop"][name] == pytest.approx(expected)
