import re
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from asysplat.evaluation.cost import count_parameters, module_flops, peak_memory_gb, true_flops

DEVICES = ["cpu", "meta"]


def test_parameters():
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2, bias=False))
    net[0].requires_grad_(False)
    assert count_parameters(net) == (3 * 4 + 4) + 2 * 4 + 4 * 2


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "layer, shape, expected",
    [
        (nn.Linear(3, 4), (2, 5, 3), 2 * 10 * 3 * 4),
        (nn.Conv2d(4, 6, 3, stride=2, padding=1, groups=2), (1, 4, 8, 8), 2 * 16 * 6 * 2 * 9),
        (nn.Conv2d(8, 8, 3, padding=1, groups=8), (1, 8, 4, 4), 2 * 16 * 8 * 9),
        (nn.Conv1d(4, 6, 5), (2, 4, 9), 2 * (2 * 5 * 6) * 4 * 5),
        (nn.Conv1d(4, 4, 5, groups=4), (2, 4, 9), 0),
        (nn.LayerNorm(7), (2, 3, 7), 4 * 42),
        (nn.BatchNorm2d(3), (2, 3, 4, 4), 4 * 96),
        (nn.RMSNorm(7), (2, 3, 7), 0),
        (nn.GELU(), (2, 3, 7), 0),
    ],
)
def test_module_flops_of_one_layer(layer, shape, expected, device):
    net = nn.Sequential(layer).to(device)
    x = torch.ones(shape, device=device)
    assert module_flops(net, lambda: net(x)) == expected


class Attention(nn.Module):
    def __init__(self, width, heads):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.out = nn.Linear(width, width, bias=False)

    def forward(self, x):
        qkv = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        y = nn.functional.scaled_dot_product_attention(q, k, v)
        return x + self.out(y.transpose(1, 2).flatten(-2))


def test_attention_products_are_in_the_true_count_only():
    batch, length, width = 2, 10, 16
    net = Attention(width, heads=4).to("meta")
    x = torch.empty(batch, length, width, device="meta")
    tokens = batch * length
    linears = 2 * tokens * 4 * width**2
    assert module_flops(net, lambda: net(x)) == linears + 4 * tokens * width
    products = 2 * 2 * batch * length * length * width  # q k^T and its product with v
    assert true_flops(lambda: net(x)) == linears + products


def test_true_count_of_an_einsum():
    a, b = torch.empty(3, 4, 5, device="meta"), torch.empty(3, 5, 6, device="meta")
    assert true_flops(lambda: torch.einsum("bij,bjk->bik", a, b)) == 2 * 3 * 4 * 5 * 6


def test_every_use_of_a_shared_module_counts_and_hooks_are_removed():
    layer = nn.Linear(2, 2)
    x = torch.ones(1, 2)
    assert module_flops(layer, lambda: layer(layer(x))) == 2 * 8
    with pytest.raises(RuntimeError):
        module_flops(layer, lambda: layer(torch.ones(1, 3)))
    assert not layer._forward_hooks


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory_of_the_process():
    status = Path("/proc/self/status").read_text()
    kilobytes = int(re.search(r"VmHWM:\s+(\d+) kB", status)[1])
    # A process may inherit a higher peak from the one that started it; the unit would differ more.
    assert 0.9 < peak_memory_gb("cpu") / (kilobytes * 1024 / 1e9) < 100


@pytest.mark.gpu
def test_peak_memory_of_a_gpu():
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    x = torch.empty(50_000_000, device="cuda")
    del x
    assert peak_memory_gb("cuda") == pytest.approx((before + 2e8) / 1e9, abs=1e-3)
