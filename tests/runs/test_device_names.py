"""The names of devices, on a Mac, on a machine with a CUDA GPU and on one with none."""

import pytest
import torch

from asysplat.errors import InputError
from asysplat.runs.machine import find_accelerator, find_device

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.fixture(params=["mac", "gpu", "none"])
def machine(request, monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: request.param == "mac")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: request.param == "gpu")
    return request.param


def test_auto_is_a_cuda_gpu_or_the_cpu(machine):
    assert find_device("auto") == (CUDA if machine == "gpu" else CPU)
    assert find_device("cpu") == CPU
    # Lightning's own "auto" would take Apple's GPU.
    assert find_accelerator("auto") == ("cpu" if machine == "mac" else "auto")
    assert find_accelerator("cpu") == "cpu" and find_accelerator("cuda") == "cuda"


def test_apples_gpu_is_refused_with_its_reason(machine):
    reason = r" is not supported: Apple's GPU has no float64.* take "
    with pytest.raises(InputError, match=rf"^device=mps{reason}device=cpu\.$"):
        find_device("mps")
    names = ("mps", "gpu") if machine == "mac" else ("mps",)
    for name in names:
        with pytest.raises(InputError, match=rf"^trainer.accelerator={name}{reason}.*=cpu\.$"):
            find_accelerator(name)
    assert machine == "mac" or find_accelerator("gpu") == "gpu"


@pytest.mark.medium
def test_scripts_refuse_apples_gpu(run_script, tmp_path):
    model = ("model=plane_sweep", f"paths.logs={tmp_path}", "trainer.accelerator=mps")
    result = run_script("evaluate.py", *model)
    assert result.returncode == 1
    assert "error: trainer.accelerator=mps is not supported: Apple's GPU" in result.stderr
