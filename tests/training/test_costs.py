"""Costs at the paper's scale, without data or memory."""

import torch

from asysplat.scene import Cameras, Views
from asysplat.training.callbacks.costs import static_costs


def test_full_width_at_32_views_of_256(build):
    net = build("scale=paper", device="meta")
    options = {"device": "meta"}
    cameras = Cameras(
        torch.empty(1, 32, 3, 3, **options), torch.empty(1, 32, 4, 4, **options), 256, 256
    )
    costs = static_costs(net, Views(cameras, torch.empty(1, 32, 3, 256, 256, **options)))
    assert abs(costs["cost/gflops"] / 2033 - 1) < 0.005  # paper, Table 6c
    assert costs["cost/gflops_true"] > 1.2 * costs["cost/gflops"]
    assert costs["cost/gaussians"] == 32 * 128 * 128
    assert round(costs["cost/parameters"] / 1e6, 2) == 98.11
