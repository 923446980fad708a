"""Counts of parameters and FLOPs; costs at the paper's scale, without data or memory."""

import math

import pytest
import torch
from saved_tensors import saved_bytes
from torch import nn

from asysplat.evaluation.static_cost import (
    NORMS,
    activation_gb,
    blank_views,
    count_parameters,
    module_flops,
    static_costs,
    true_flops,
)
from asysplat.models.attention import CrossAttention, SelfAttention
from asysplat.models.mamba import Mamba2Direction, MambaVisionMixer
from asysplat.ops.ssd.reference import CHUNK


@pytest.mark.medium
def test_static_costs_at_the_papers_scale_are_the_papers(build):
    costs = static_costs(build("model=asysplat_4m4s", "scale=paper", device="meta"), 32, 256, 256)
    assert abs(costs["gflops"] / 2033 - 1) < 0.005  # paper, Table 6c
    assert costs["gflops_true"] > 1.2 * costs["gflops"]
    assert costs["gaussians"] == 32 * 128 * 128
    assert round(costs["parameters"] / 1e6, 2) == 98.11
    assert round(costs["geometry_ratio"], 3) == 0.905
    assert 20 < costs["activation_gb"] < 30


@pytest.mark.medium
def test_activation_memory_is_what_a_forward_pass_saves(build):
    net = build("model=asysplat_4m4s", "width=0.125", "state_size=8")
    views = blank_views(2, 64, 64).map(torch.zeros_like)
    _, saved = saved_bytes(net, lambda: net(views))
    assert activation_gb(net, 2, 64, 64) == saved / 1e9


def test_parameters_include_frozen_ones_and_no_buffers():
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2, bias=False))
    net[0].requires_grad_(False)
    assert count_parameters(net) == (3 * 4 + 4) + 2 * 4 + 4 * 2


@pytest.mark.parametrize("device", ["cpu", "meta"])
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
def test_module_flops_of_each_layer(layer, shape, expected, device):
    net = nn.Sequential(layer).to(device)
    x = torch.ones(shape, device=device)
    assert module_flops(net, x)[0] == expected


class Attention(nn.Module):
    """Attention among the rows of all images."""

    def __init__(self, width):
        super().__init__()
        self.qkv = nn.Linear(width, 3 * width, bias=False)

    def forward(self, views):
        q, k, v = self.qkv(views.images.flatten(1, 3)).chunk(3, -1)
        return nn.functional.scaled_dot_product_attention(q, k, v)


def test_attention_products_are_in_the_true_count_only():
    views, height, width = 2, 4, 16
    with torch.device("meta"):
        net, inputs = Attention(width), blank_views(views, height, width)
    tokens = views * 3 * height
    assert module_flops(net, inputs)[0] == 2 * tokens * width * 3 * width
    products = 2 * 2 * tokens * tokens * width  # q k^T and its product with v
    assert true_flops(net, views, height, width) == 2 * tokens * width * 3 * width + products


def omitted_flops(module: nn.Module, inputs: tuple[torch.Tensor, ...]) -> int:
    """By hand, from the shapes: the true count of a module without that of its modules."""
    tokens = inputs[0]
    if isinstance(module, (SelfAttention, CrossAttention)):
        scenes, views, *size, width = tokens.shape
        if isinstance(module, SelfAttention):  # a query sees the keys of its place of the grid
            queries = scenes * views * math.prod(size)
            keys = views * math.prod(size) // module.grid**2
        else:  # those of its view
            queries, keys = scenes * views * math.prod(size), math.prod(inputs[1].shape[2:4])
            width = module.query.out_features
        return 2 * 2 * queries * keys * width  # q k^T and its product with v
    if isinstance(module, Mamba2Direction):
        length, inner, state = math.prod(tokens.shape[:2]), module.splits[0], module.state_size
        conv = 2 * length * module.conv.in_channels * module.conv.kernel_size[0]
        within_chunks = 2 * length * CHUNK * (state + inner)  # C B^T and its product with x
        states = 2 * 2 * length * inner * state  # written and read
        return conv + within_chunks + states
    if isinstance(module, MambaVisionMixer):
        length, width = math.prod(tokens.shape[:2]), tokens.shape[-1]
        scanned, state = module.A_log.shape
        return 2 * length * width * 3 + 2 * 2 * length * scanned * state
    # Norms are no products.
    return -4 * tokens.numel() if isinstance(module, NORMS) else 0


@pytest.mark.medium
@pytest.mark.parametrize("model", ["asysplat_4m4s", "longlrm"])
def test_the_true_count_has_what_the_modules_omit(build, model):
    """Attention products, scans and depthwise convolutions; it has no norms."""
    net = build(f"model={model}", "width=0.125", "state_size=8", device="meta")
    omitted = []

    def count(module, inputs):
        omitted.append(omitted_flops(module, inputs))

    hooks = [m.register_forward_pre_hook(count) for m in net.modules()]
    with torch.device("meta"), torch.no_grad():
        modules, _ = module_flops(net, blank_views(2, 64, 96))
    for hook in hooks:
        hook.remove()
    assert true_flops(net, 2, 64, 96) == modules + sum(omitted)


def test_every_use_of_a_shared_module_counts_and_hooks_are_removed():
    layer = nn.Linear(2, 2)
    x = torch.ones(1, 2)
    assert module_flops(nn.Sequential(layer, layer), x)[0] == 2 * 8
    with pytest.raises(RuntimeError):
        module_flops(layer, torch.ones(1, 3))
    assert not layer._forward_hooks
