"""Grid attention: which tokens attend to each other; stress/ compares its values."""

import torch

from asysplat.ops import grid_attention


def test_a_token_attends_to_its_grid_place_in_all_views_only():
    q, k, v = torch.randn(3, 2, 3, 4, 6, 2, 8, dtype=torch.float64).unbind(0)
    v.requires_grad_()
    grid_attention(q, k, v, grid=2)[0, 0, 1, 2].sum().backward()
    attended = v.grad.abs().sum((-1, -2))[0] > 0
    expected = torch.zeros_like(attended)
    expected[:, 1::2, 0::2] = True
    assert torch.equal(attended, expected)
