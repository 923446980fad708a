"""The plane sweep's kernels compile for GPUs: the interpreter accepts more than the compiler."""

import pytest
import torch
from compiler import collect_kernels

triton = pytest.importorskip("triton")

pytestmark = pytest.mark.medium


@pytest.mark.parametrize("architecture", [80, 90], ids="sm_{}".format)
def test_all_kernels_compile(monkeypatch, architecture):
    from asysplat.ops.plane_sweep import cuda

    kernels = collect_kernels(monkeypatch, architecture, ["REVERSE"])
    neighbors = torch.tensor([[[1, -1, -1, -1], [0, -1, -1, -1]]])
    costs = cuda.cost_volume(
        *(torch.zeros(1, 2, 8, 12), neighbors, torch.zeros(1, 2, 4, 3, 4), torch.zeros(1, 2, 2)),
        planes=48,
        stride=2,
    )
    cuda.sgm(costs, torch.ones(1, 2, 4, 6), torch.zeros(1, 2, 2, 4, 6))
    assert {name for name, _ in kernels} == {"cost_band", "add_paths"}
    assert all(kernel.asm["cubin"] for kernel in kernels.values())
