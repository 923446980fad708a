"""GPU kernels that are wrong, or do not run, are found out before their results are used."""

import json
import re
import warnings

import pytest
import torch
from compiler import DEVICE, kernel

from asysplat.kernels import self_check
from asysplat.kernels.dispatch import choose_fastest
from asysplat.kernels.self_check import TOLERANCE, find_fault

GPU = torch.device("cuda", 0)
OPERATORS = ("adam", "conv_silu", "ssd", "selective_scan", "plane_sweep", "image_loss")
CHECKS = [f"asysplat.ops.self_check:{name}" for name in OPERATORS]
CHECKS += ["asysplat.rendering.self_check:render"]

error = 0.0  # the error that the check `compare` returns, or an exception to be raised
runs = 0


class OnGpu(torch.Tensor):
    """A tensor that says that it is on GPU."""

    device = GPU


def compare(device, backend):
    global runs
    runs += 1
    assert (device, backend) == (GPU, "cuda") and torch.is_grad_enabled()
    if isinstance(error, Exception):
        raise error
    return {"outputs": 0.0, "gradients": error}


@pytest.fixture
def backend(monkeypatch, tmp_path):
    """Choose a backend on a GPU that is not there, in a new process or in the same."""
    monkeypatch.setattr("asysplat.kernels.simd.threads.find_home_cache", lambda: tmp_path)
    monkeypatch.setattr(self_check, "describe_gpu", lambda device: "a GPU of 1999")
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr("asysplat.kernels.dispatch.find_spec", lambda name: "triton")
    monkeypatch.setitem(globals(), "runs", 0)

    def choose(result, new_process=True):
        monkeypatch.setitem(globals(), "error", result)
        if new_process:
            find_fault.cache_clear()
        return choose_fastest(torch.zeros(1).as_subclass(OnGpu), "reference", f"{__name__}:compare")

    yield choose
    find_fault.cache_clear()


def test_right_kernels_are_checked_once_and_used_without_a_word(backend):
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("error")
        assert backend(1e-6) == "cuda"
        assert backend(1e-6, new_process=False) == backend(1e-6) == "cuda"
    assert runs == 1


@pytest.mark.parametrize(
    "result, reason",
    [
        (2.0, "have a relative error of 2.0e[+]00"),
        (float("nan"), "have a relative error of nan"),
        (RuntimeError("PTX was\ncompiled by a fool"), r"do not run \(RuntimeError: PTX was\)"),
    ],
)
def test_torch_takes_the_place_of_kernels_that_are_wrong(backend, tmp_path, result, reason):
    with torch.inference_mode(), pytest.warns(UserWarning) as found:
        assert backend(result) == "reference"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert backend(result, new_process=False) == "reference"
    (file,) = tmp_path.iterdir()
    assert json.loads(file.read_text())["gpu"] == "a GPU of 1999"
    (message,) = [str(warning.message) for warning in found]
    assert re.match(
        f"compare's kernels {reason} on a GPU of 1999: torch computes it, .*remove {file} ", message
    )
    with pytest.warns(UserWarning):  # the verdict of the first process
        assert backend(0.0) == "reference"
    assert runs == 1
    file.write_text("damaged")
    assert backend(0.0) == "cuda" and runs == 2


def test_a_full_gpu_is_no_verdict(backend, tmp_path):
    with pytest.raises(torch.OutOfMemoryError):
        backend(torch.OutOfMemoryError("CUDA out of memory"))
    assert not list(tmp_path.iterdir())
    assert backend(0.0) == "cuda"


@kernel
@pytest.mark.parametrize("check", CHECKS)
def test_our_kernels_are_right(check):
    assert self_check._compare(self_check.resolve_name(check), torch.device(DEVICE)) == ""


@pytest.mark.medium
@pytest.mark.parametrize("check", CHECKS)
def test_kernels_of_the_processor_pass_the_same_checks(check):
    errors = self_check.resolve_name(check)(torch.device("cpu"), "cpu")
    assert 0 < max(errors.values()) < TOLERANCE / 10


@kernel
def test_a_flipped_sign_is_found(monkeypatch):
    from asysplat.ops import self_check as checks
    from asysplat.ops.adam import cuda

    table, signs = cuda._corrections_on, torch.tensor([-1.0, 1.0], device=DEVICE)
    monkeypatch.setattr(cuda, "_corrections_on", lambda *arguments: signs * table(*arguments))
    assert checks.adam(torch.device(DEVICE), "cuda")["outputs"] > 10 * TOLERANCE
