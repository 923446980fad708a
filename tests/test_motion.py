"""Rigid motions; tests/data/test_normalize.py compares renderings."""

import math

import torch

from asysplat.motion import transform


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
