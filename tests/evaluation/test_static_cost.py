"""Costs at the paper's scale, without data or memory."""

import torch

from asysplat.evaluation.static_cost import activation_gb, blank_views, static_costs


def test_full_width_at_32_views_of_256(build):
    costs = static_costs(build("model=asysplat_4m4s", "scale=paper", device="meta"), 32, 256, 256)
    assert abs(costs["gflops"] / 2033 - 1) < 0.005  # paper, Table 6c
    assert costs["gflops_true"] > 1.2 * costs["gflops"]
    assert costs["gaussians"] == 32 * 128 * 128
    assert round(costs["parameters"] / 1e6, 2) == 98.11
    assert round(costs["geometry_share"], 3) == 0.905
    assert 20 < costs["activation_gb"] < 30


def test_activation_memory_is_what_a_forward_pass_saves(build):
    net = build("model=asysplat_4m4s", "width=0.125", "state_size=8")
    views = blank_views(2, 64, 64).map(torch.zeros_like)
    parameters = {p.untyped_storage().data_ptr() for p in [*net.parameters(), *net.buffers()]}
    saved = {}

    def save(tensor):
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            saved[storage.data_ptr()] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor):
        net(views)
    assert activation_gb(net, 2, 64, 64) == sum(s.nbytes() for s in saved.values()) / 1e9
