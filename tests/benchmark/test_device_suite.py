"""The suite on tiny cases: right kernels, wrong ones, some that do not run, and other libraries."""

import re
import sys

import pytest

from asysplat.kernels.self_check import TOLERANCE
from asysplat.ops.adam import cpu as adam_kernels
from asysplat.ops.ssd import cpu as ssd_kernels
from benchmarks import libraries
from benchmarks.device import CASES, SIZES, measure_operator, verdict
from benchmarks.options import CPU

TINY = {
    "render": {"gaussians": 50, "height": 20, "width": 24},
    "render_1M": {"gaussians": 70, "height": 20, "width": 24},
    "ssd": {"batch": 1, "length": 20, "heads": 2, "head_dim": 16, "state": 16},
    "selective_scan": {"batch": 2, "length": 20, "channels": 16, "state": 16},
    "conv_silu": {"batch": 2, "length": 20, "channels": 18, "size": 4, "before": 3},
    "plane_sweep": {"batch": 1, "views": 3, "height": 16, "width": 20, "planes": 8, "neighbors": 2},
    "grid_attention": {"batch": 1, "views": 2, "height": 4, "width": 6}
    | {"heads": 2, "head_dim": 8, "grid": 2},
    "adam": {"gaussians": 50},
    "image_loss": {"images": 2, "height": 12, "width": 16},
}
WITHOUT_GRADIENTS = {"render forward", "plane_sweep", "adam"}
LARGE = {"render_1M"}  # not timed in torch

pytestmark = pytest.mark.medium


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Measure tiny cases, without the libraries that the machine has."""
    monkeypatch.setitem(SIZES, "cpu", TINY)
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)


def test_every_operator_is_right_and_timed(run_suite):
    results = run_suite("device", {})
    assert verdict(results) is None
    assert [row["operator"] for row in results["rows"]] == list(CASES)
    for row in results["rows"]:
        names = {"outputs"} if row["operator"] in WITHOUT_GRADIENTS else {"outputs", "gradients"}
        assert row["error"].keys() == names and row["backend"] == "cpu"
        assert all(0 < error < TOLERANCE for error in row["error"].values())
        assert row["first"] > 0 and row["kernels"]["median"] > 0
        assert (row["torch"] is None) == (row["operator"] in LARGE)
        assert row["fault"] == "" and row["notes"] == [] and row["library"] is None


def test_wrong_kernels_are_found_and_those_that_do_not_run_have_a_reason(run_suite, monkeypatch):
    constants, case = adam_kernels._constants, CASES["image_loss"]

    def flipped(settings):
        right = constants(settings)
        return right._replace(new1=-right.new1)

    def fail(*arguments):
        raise RuntimeError("no such instruction\nin line 3")

    def doubled(sizes, device):
        right = case(sizes, device)
        return right._replace(run=lambda backend: right.run(backend) * (1 + (backend == "cpu")))

    monkeypatch.setattr(adam_kernels, "_constants", flipped)
    monkeypatch.setattr(ssd_kernels, "forward", fail)
    monkeypatch.setitem(CASES, "image_loss", doubled)
    message = (
        r"^wrong: ssd's kernels do not run \(RuntimeError: no such instruction\); adam's kernels "
        r"have a relative error of \S+; image_loss's kernels differ from torch by 100% where timed$"
    )
    with pytest.raises(SystemExit, match=message):
        run_suite("device", {})


@pytest.mark.parametrize(
    "source, note",
    [
        ("raise ImportError('for another torch')", r" ?does not run \(ImportError: for another"),
        ("def flash_attn_func(q, k, v): return 2 * q + 0 * (k + v)", r"'s output differs by \d+%"),
    ],
)
def test_a_library_that_fails_is_a_note(monkeypatch, tmp_path, source, note):
    (tmp_path / "flash_attn.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(libraries, "find_spec", lambda name: name == "flash_attn" or None)
    monkeypatch.delitem(sys.modules, "flash_attn", raising=False)
    row = measure_operator("grid_attention", CPU, repeats=1)
    monkeypatch.delitem(sys.modules, "flash_attn", raising=False)
    assert row["library"] is None and row["fault"] == "" and row["kernels"]["median"] > 0
    (found,) = row["notes"]
    assert re.match(f"flash_attn{note}", found)
