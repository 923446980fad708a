"""Rigid motions and similarities; tests/data/test_normalize.py compares renderings."""

import math

import pytest
import torch

from asysplat.geometry.motion import fit_similarity, transform


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


@pytest.mark.parametrize("seed", range(5))
def test_a_similarity_is_found_again(seed):
    torch.manual_seed(seed)
    source = torch.randn(7, 3, dtype=torch.float64) * 3 + 1000 * torch.randn(3)
    skew = torch.randn(3, 3, dtype=torch.float64)
    rotation, shift = torch.linalg.matrix_exp(skew - skew.mT), torch.randn(3) * 50
    factor = 10 ** (2 * torch.rand(()).item() - 1)
    target = factor * (source @ rotation.mT + shift)
    motion, scale = fit_similarity(source, target)
    assert scale == pytest.approx(factor, rel=1e-9)
    torch.testing.assert_close(motion[:3, :3], rotation, atol=1e-9, rtol=0)
    found = scale * (source @ motion[:3, :3].mT + motion[:3, 3])
    torch.testing.assert_close(found, target, atol=1e-7, rtol=1e-9)


def test_a_similarity_does_not_mirror_and_is_the_best():
    source = torch.randn(20, 3, dtype=torch.float64)
    target = source * torch.tensor([1.0, 1.0, -1.0]) + 0.1 * torch.randn(20, 3)
    motion, scale = fit_similarity(source, target)
    assert torch.linalg.det(motion).item() == pytest.approx(1)

    def error(motion, scale):
        found = scale * (source @ motion[:3, :3].mT + motion[:3, 3])
        return (found - target).square().sum().item()

    best = error(motion, scale)
    for _ in range(20):
        skew = 0.05 * torch.randn(3, 3, dtype=torch.float64)
        other = motion.clone()
        other[:3, :3] = torch.linalg.matrix_exp(skew - skew.mT) @ motion[:3, :3]
        other[:3, 3] += 0.02 * torch.randn(3)
        assert error(other, scale) > best and error(motion, scale * 1.02) > best
