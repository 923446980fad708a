"""Gaussians that move keep their shapes, and their colors as seen from cameras that move along."""

import math

import torch

from asysplat.motion import transform


def motion(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    skew = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.linalg.matrix_exp(skew - skew.mT)
    matrix[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix


def test_means_and_orientations(make_scene):
    gaussians, _ = make_scene()
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    turn[:3, 3] = torch.tensor([1.0, 2, 3])
    found = transform(gaussians, turn)
    x, y, z = gaussians.means.unbind(-1)
    torch.testing.assert_close(found.means, torch.stack((1 - y, 2 + x, 3 + z), -1))
    w, x, y, z = gaussians.quats.unbind(-1)
    # The quaternion of a quarter turn about z is (1, 0, 0, 1) / sqrt 2.
    expected = torch.stack((w - z, x - y, y + x, z + w), -1) / math.sqrt(2)
    torch.testing.assert_close(found.quats, expected)
    assert torch.equal(found.scales, gaussians.scales)


def test_there_and_back_is_where_it_was(make_scene):
    gaussians, _ = make_scene(degree=3)
    there = motion(1)
    back = transform(transform(gaussians, there), torch.linalg.inv(there))
    for name in ("means", "sh"):
        torch.testing.assert_close(
            getattr(back, name), getattr(gaussians, name), atol=1e-12, rtol=0
        )
    same = (back.quats * gaussians.quats).sum(-1).abs() / gaussians.quats.square().sum(-1)
    torch.testing.assert_close(same, torch.ones_like(same))
