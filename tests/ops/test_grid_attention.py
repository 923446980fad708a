"""Grid attention: the fused form against the masked softmax, and what a token can see."""

import pytest
import torch

from asysplat.ops import grid_attention


def qkv(height=4, width=6, dtype=torch.float64):
    return torch.randn(3, 2, 3, height, width, 2, 8, dtype=dtype).unbind(0)


@pytest.mark.parametrize("grid", [1, 2])
def test_fused_equals_masked_softmax(grid):
    q, k, v = qkv()
    expected = grid_attention(q, k, v, grid, backend="reference")
    torch.testing.assert_close(grid_attention(q, k, v, grid), expected)


def test_a_token_sees_its_grid_place_in_all_views_only():
    q, k, v = qkv()
    v.requires_grad_()
    grid_attention(q, k, v, grid=2)[0, 0, 1, 2].sum().backward()
    seen = v.grad.abs().sum((-1, -2))[0] > 0
    expected = torch.zeros_like(seen)
    expected[:, 1::2, 0::2] = True
    assert torch.equal(seen, expected)
