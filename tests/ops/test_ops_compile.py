"""The operators' kernels compile for GPUs: the interpreter accepts more than the compiler."""

from importlib import import_module

import pytest
import torch
from compiler import collect_kernels
from scans import SCANS, make_arguments

triton = pytest.importorskip("triton")

pytestmark = pytest.mark.medium

KERNELS = {
    "ssd": {
        *("sum_decays", "pass_states", "score_chunk", "forward_chunk"),
        *("head_gradients", "score_gradients", "projection_gradients"),
    },
    "selective_scan": {"sum_chunk", "pass_states", "forward_chunk", "backward_chunk"},
}


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize(
    "architecture, dtype",
    [pytest.param(80, torch.float32, marks=pytest.mark.slow), (90, torch.bfloat16)],
)
def test_all_kernels_of_scans_compile(monkeypatch, name, architecture, dtype):
    scan = import_module("asysplat.ops.selective_scan.cuda.scan")
    kernels = collect_kernels(monkeypatch, architecture, ["GRADIENT", "OF_B"])
    monkeypatch.setattr("asysplat.kernels.dispatch._uses_interpreter", lambda backend: True)
    # Few unrolled tokens: the compiler takes seconds for each.
    monkeypatch.setattr(scan, "FORWARD_CHUNK", 2)
    monkeypatch.setattr(scan, "BACKWARD_CHUNK", 2)
    sizes = {"channels": 2, "head_dim": 16, "state": 128 if name == "ssd" else 16}
    x, *others = make_arguments(name, 70, batch=1, dtype=dtype, **sizes)
    SCANS[name](x.requires_grad_(), *others, backend="cuda").sum().backward()
    assert {kernel for kernel, *_ in kernels} == KERNELS[name]
    assert all(kernel.asm["cubin"] for kernel in kernels.values())


@pytest.mark.parametrize("architecture", [pytest.param(80, marks=pytest.mark.slow), 90])
def test_all_kernels_of_the_plane_sweep_compile(monkeypatch, architecture):
    from asysplat.ops.plane_sweep import cuda

    kernels = collect_kernels(monkeypatch, architecture, ["REVERSE"])
    neighbors = torch.tensor([[[1, -1, -1, -1], [0, -1, -1, -1]]])
    costs = cuda.cost_volume(
        *(torch.zeros(1, 2, 8, 12), neighbors, torch.zeros(1, 2, 4, 3, 4), torch.zeros(1, 2, 2)),
        planes=48,
    )
    maps = torch.ones(1, 2, 8, 12)
    cuda.sgm(costs, maps, torch.zeros(1, 2, 2, 8, 12))
    cuda.consistency(maps, torch.ones(1, 2), maps, neighbors, torch.zeros(1, 2, 4, 3, 4))
    assert {name for name, _ in kernels} == {"cost_band", "add_paths", "count_views"}
    assert all(kernel.asm["cubin"] for kernel in kernels.values())
