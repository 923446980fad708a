"""The plane sweep's kernels compile for GPUs: the interpreter accepts more than the compiler."""

import pytest
import torch
from compiler import compiled

triton = pytest.importorskip("triton")

pytestmark = pytest.mark.medium


@pytest.mark.parametrize("architecture", [80, 90], ids="sm_{}".format)
def test_all_kernels_compile(monkeypatch, architecture):
    from triton.runtime.jit import JITFunction

    from asysplat.ops.plane_sweep import cuda

    kernels = {}

    def run(kernel, *arguments, grid, warmup, **others):
        arguments = dict(zip(kernel.arg_names, arguments, strict=False)) | others
        name = kernel.fn.__name__, arguments.get("REVERSE")
        if name not in kernels:
            kernels[name] = compiled(kernel, arguments, architecture)

    monkeypatch.setattr(JITFunction, "run", run)
    neighbors = torch.tensor([[[1, -1, -1, -1], [0, -1, -1, -1]]])
    costs = cuda.cost_volume(
        *(torch.zeros(1, 2, 8, 12), neighbors, torch.zeros(1, 2, 4, 3, 4), torch.zeros(1, 2, 2)),
        planes=48,
        stride=2,
    )
    cuda.sgm(costs, torch.ones(1, 2, 4, 6), torch.zeros(1, 2, 2, 4, 6))
    assert {name for name, _ in kernels} == {"cost_band", "add_paths"}
    assert all(kernel.asm["cubin"] for kernel in kernels.values())
