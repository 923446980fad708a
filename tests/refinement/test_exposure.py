"""Exposures: found from what photographs share, made even, predicted, and fitted by metrics."""

from dataclasses import replace

import pytest
import torch
from pretend_device import DEVICE, pretended_device

from asysplat.evaluation.metrics import fit_exposure, psnr
from asysplat.refinement import DEFAULT, refine
from asysplat.refinement.exposure import (
    even_exposures,
    expose,
    find_exposures,
    predict_exposures,
)
from asysplat.refinement.init import initial_gaussians
from asysplat.rendering import render


@pytest.fixture(scope="module")
def jumps():
    """Half a stop more or less, in the colors as they are stored, and a change of white balance."""
    signs = torch.tensor([1.0, -1, -1, 1, -1, 1, 1, 1, -1, -1, 1, -1])[:, None]
    return 0.158 * signs + 0.05 * signs.roll(3, 0) * torch.tensor([1.0, 0.0, -1.0])


def photographed(views, exposures):
    images = expose(views.images, exposures).clamp(0, 1)
    return replace(views, images=(images * 255).round() / 255)


def test_exposures_that_jump_are_found(room, jumps):
    inputs = room[0]
    assert find_exposures(inputs) is None
    found = find_exposures(photographed(inputs, jumps))
    assert found is not None
    expected = jumps - jumps.mean(0)
    assert (found - expected).abs().max() < 0.03
    assert found.mean(0).abs().max() < 1e-6


def test_what_is_masked_out_and_what_is_composed_says_nothing_of_exposures(room, jumps):
    dark = photographed(room[0], jumps)
    masks = torch.ones_like(dark.images[:, 0], dtype=torch.bool)
    masks[:, :15] = False
    masked = replace(dark, images=dark.images.where(masks[:, None], 0.5), masks=masks)
    found = find_exposures(masked)
    assert found is not None and (found - jumps + jumps.mean(0)).abs().max() < 0.04
    assert find_exposures(replace(dark, alphas=torch.ones_like(dark.images[:, 0]))) is None


def test_slow_changes_are_predicted_and_jumps_are_not(room, jumps):
    inputs, held = (views.cameras for views in room)
    slow = torch.linspace(-0.3, 0.3, 12)[:, None].expand(12, 3)
    expected = torch.tensor([3.0, 11, 19])[:, None] / 22 * 0.6 - 0.3
    assert (predict_exposures(slow, inputs, held) - expected).abs().max() < 0.08
    assert predict_exposures(jumps - jumps.mean(0), inputs, held).abs().max() < 0.05


def test_what_is_clipped_in_a_brighter_photograph_is_masked_out(room):
    views = replace(room[0].select([0, 1]), masks=None)
    images = torch.full_like(views.images, 0.5)
    images[:, 0, :10], images[:, :, 20] = 1.0, 0.75
    exposures = torch.tensor([[0.2], [-0.2]]).expand(2, 3)
    even = even_exposures(replace(views, images=images), exposures)
    assert even.masks is not None and even.masks[1].all()
    assert not even.masks[0, :10].any() and even.masks[0, 10:].all()
    torch.testing.assert_close(
        even.images, (images * (-exposures).exp()[..., None, None]).clamp(0, 1)
    )


@pytest.mark.medium
def test_a_scene_of_jumping_exposures_is_as_good_as_of_even_ones(room, jumps):
    inputs, held = room
    dark = photographed(inputs, jumps)
    found = find_exposures(dark)
    assert found is not None
    quality = {}
    views = {"even": inputs, "jumping": dark, "corrected": even_exposures(dark, found)}
    for name, photographs in views.items():
        start = initial_gaussians("plane_sweep", photographs, DEFAULT.initial_limit)
        scene = refine(start, photographs, steps=150)
        with torch.no_grad():
            image = render(scene, held.cameras, photographs.mean_color()).image
        quality[name] = psnr(fit_exposure(image, held.images), held.images).mean().item()
    assert quality["corrected"] > quality["even"] - 0.5, quality
    assert quality["corrected"] > quality["jumping"] + 1, quality


def test_a_fitted_exposure_restores_a_gain_and_an_offset():
    target = torch.rand(2, 3, 8, 9, generator=torch.Generator().manual_seed(0))
    changed = target * torch.tensor([0.5, 0.7, 1.2])[:, None, None] + 0.1
    masks = torch.ones(2, 8, 9, dtype=torch.bool)
    masks[:, 0] = False
    changed[:, :, 0] = 0
    torch.testing.assert_close(fit_exposure(changed, target, masks)[:, :, 1:], target[:, :, 1:])
    torch.testing.assert_close(
        fit_exposure(torch.zeros(1, 3, 8, 9), target[:1]),
        target[:1].mean((-2, -1), keepdim=True).expand(1, 3, 8, 9),
    )


def test_exposures_are_found_on_a_device(room, jumps, monkeypatch):
    dark, held = photographed(room[0], jumps), room[1].cameras
    with pretended_device(monkeypatch) as device:
        there = dark.to(device)
        found = find_exposures(there)
        assert found is not None and found.device == DEVICE
        assert even_exposures(there, found).images.device == DEVICE
        assert predict_exposures(found, there.cameras, held.to(device)).device == DEVICE
