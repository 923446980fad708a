"""Pruning by opacity, as Long-LRM's last stage."""

import pytest
import torch
from pydantic import ValidationError

from asysplat.models import Prune
from asysplat.scene import Gaussians


def gaussians(opacities):
    batch, count = opacities.shape
    means = torch.arange(batch * count * 3.0).view(batch, count, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(batch, count, 4)
    return Gaussians(means, quats, torch.ones_like(means), opacities, means[..., None, :])


def test_keeps_the_most_opaque_and_a_few_of_all_others():
    opacities = torch.rand(2, 1000, generator=torch.Generator().manual_seed(0))
    scene = gaussians(opacities)
    kept = Prune(prune_ratio=0.6, random_ratio=0.1)(scene)
    assert kept.num_gaussians == 400
    for old, new, means in zip(opacities, kept.opacities, kept.means, strict=True):
        top, others = old.sort(descending=True).values.split((360, 640))
        assert torch.equal(new[:360], top)
        # 40 of the 640 others: none twice, from the whole range, the same fraction of each quarter.
        assert len(means.unique(dim=0)) == 400
        quarters = [torch.isin(new[360:], part).sum() for part in others.split(160)]
        assert quarters == [10, 10, 10, 10]
    # All fields of a Gaussian stay together.
    assert torch.equal(kept.sh[..., 0, :], kept.means)
    index = (kept.means[..., 0] / 3).long() % 1000
    assert torch.equal(opacities.gather(1, index), kept.opacities)


def test_gradients_reach_the_kept_ones_alone():
    opacities = torch.tensor([[0.1, 0.9, 0.5, 0.3]], requires_grad=True)
    Prune(0.5)(gaussians(opacities)).opacities.sum().backward()
    assert opacities.grad.tolist() == [[0, 1, 1, 0]]


def test_nothing_to_prune_changes_nothing():
    scene = gaussians(torch.rand(1, 8))
    assert Prune(0.0, 0.1)(scene) is scene
    assert Prune(0.99)(scene).num_gaussians == 1


def test_ratios_out_of_range_are_refused():
    with pytest.raises(ValidationError, match=r"model\.prune"):
        Prune(1.0, 0.0)


def test_long_lrm_prunes_in_its_last_stage_alone(build):
    tiny = ["width=0.125", "state_size=8", "model=longlrm"]
    assert build(*tiny).prune == Prune(0.0, 0.1)
    assert build(*tiny, "stage=stage3").prune == Prune(0.5, 0.1)
