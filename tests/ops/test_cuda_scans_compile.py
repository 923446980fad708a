"""The scans' kernels compile for GPUs: the interpreter accepts more than the compiler."""

from importlib import import_module

import pytest
import torch
from compiler import collect_kernels

from asysplat.ops import selective_scan, ssd

triton = pytest.importorskip("triton")

pytestmark = pytest.mark.medium

SCANS = {"ssd": ssd, "selective_scan": selective_scan}
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
    [(80, torch.float32), (90, torch.bfloat16)],
    ids=["sm_80-fp32", "sm_90-bf16"],
)
def test_all_kernels_compile(monkeypatch, name, architecture, dtype):
    scan = import_module("asysplat.ops.selective_scan.cuda.scan")
    kernels = collect_kernels(monkeypatch, architecture, ["GRADIENT", "OF_B"])
    monkeypatch.setattr("asysplat.ops.dispatch._interpreted", lambda backend: True)
    # Few unrolled tokens: the compiler takes seconds for each.
    monkeypatch.setattr(scan, "FORWARD_CHUNK", 2)
    monkeypatch.setattr(scan, "BACKWARD_CHUNK", 2)
    heads, state = ((2, 16), 128) if name == "ssd" else ((2,), 16)
    x = torch.zeros(1, 70, *heads, dtype=dtype, requires_grad=True)
    projection = torch.zeros(1, 70, state, dtype=dtype)
    rates = torch.zeros(2) if name == "ssd" else torch.zeros(2, state)
    dt, skip = torch.zeros(1, 70, 2), torch.zeros(2)
    y = SCANS[name](x, dt, rates, projection, projection, skip, backend="cuda")
    y.sum().backward()
    assert {kernel for kernel, *_ in kernels} == KERNELS[name]
    assert all(kernel.asm["cubin"] for kernel in kernels.values())
