"""3DGS-MCMC: dead Gaussians are relocated to live ones; faint ones get position noise."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.refinement.densification.relocate import (
    MAX_COPIES,
    NOISE,
    REGULARIZER,
    inject_position_noise,
    mcmc_regularizer,
    relocate,
    split_opacity_and_scale,
)
from asysplat.refinement.densification.spawn import MIN_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.refinement.isotropic import isotropic_gaussians
from asysplat.refinement.settings import Rates
from asysplat.rendering import render
from asysplat.rendering.reference.math import rotations


@pytest.fixture
def scene(make_scene):
    return make_scene(count=80, height=40, width=52, dtype=torch.float32)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def fields_of(gaussians):
    return Fields(gaussians, torch.linspace(0.5, 2, gaussians.num_gaussians))


def draw(gaussians, cameras):
    return render(gaussians, cameras, torch.full((3,), 0.5), depth=False).image


def double_sum(opacity, count):
    """Eq. 9 as it is printed: the factor of the scales."""
    each = 1 - (1 - opacity) ** (1 / count)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )
    return opacity / total


@pytest.mark.parametrize("count", [1, 2, 3, 10, MAX_COPIES])
def test_any_number_of_copies_as_in_equation_9(count):
    opacities, scales = torch.linspace(0.3, 0.99, 7), torch.rand(7, 3)
    found, sizes = split_opacity_and_scale(opacities, scales, torch.full((7,), count))
    exact = (1 - (1 - opacities.double()) ** (1 / count)).float().clamp_min(MIN_OPACITY)
    torch.testing.assert_close(found, exact)
    factors = torch.tensor([double_sum(opacity, count) for opacity in opacities.tolist()])
    torch.testing.assert_close(sizes, scales * factors[:, None], rtol=1e-4, atol=0)
    if count == 1:
        torch.testing.assert_close((found, sizes), (opacities, scales))


def test_more_than_max_copies_count_as_max_copies():
    one = torch.tensor([0.9, 1.0]), torch.ones(2, 3)
    most = split_opacity_and_scale(*one, torch.full((2,), MAX_COPIES))
    more = split_opacity_and_scale(*one, torch.full((2,), 1000))
    assert torch.equal(more[0], most[0]) and torch.equal(more[1], most[1])
    assert more[0].isfinite().all() and (more[1] > 0).all() and more[1].isfinite().all()


@pytest.mark.parametrize("dead", [1, 40])
def test_the_image_stays_when_dead_gaussians_move(scene, dead):
    gaussians, cameras = scene
    gaussians.opacities[:dead] = MIN_OPACITY / 2
    fields = fields_of(gaussians)
    before = draw(gaussians, cameras)
    relocate(fields, 80, 0.0, generator())
    found = fields.gaussians().validate()
    assert found.num_gaussians == 80
    assert (found.opacities > MIN_OPACITY).all()
    assert not torch.equal(found.opacities, gaussians.opacities)
    assert (draw(found, cameras) - before).abs().mean() <= 1e-2
    uncorrected = gaussians.map(lambda field: torch.cat((field[40:], field[40:])))
    assert dead < 40 or (draw(uncorrected, cameras) - before).abs().mean() > 2e-2


def test_copies_are_added_up_to_the_limit_and_the_image_stays(scene):
    gaussians, cameras = scene
    limits = ((1000, 0.5, 120), (100, 0.5, 100), (80, 1.0, 80), (20, 1.0, 80), (200, 0.05, 84))
    for most, growth, expected in limits:
        fields = fields_of(gaussians)
        relocate(fields, most, growth, generator())
        assert len(fields) == expected
        difference = draw(fields.gaussians(), cameras) - draw(gaussians, cameras)
        assert difference.abs().mean() <= 1e-2


def test_copies_have_the_fields_of_their_original(scene):
    gaussians = scene[0]
    gaussians.opacities[:30] = MIN_OPACITY / 2
    fields = fields_of(gaussians)
    old_units = fields.units
    relocate(fields, 80, 0.0, generator())
    found = fields.gaussians()
    # Each is at the place of a live one, with its turn, color and unit.
    same = (found.means[:, None] == gaussians.means[None, 30:]).all(-1)
    assert (same.sum(1) == 1).all() and (same.sum(0) >= 1).all()
    source = 30 + same.int().argmax(1)
    for name in ("quats", "sh"):
        assert torch.equal(getattr(found, name), getattr(gaussians, name)[source])
    assert torch.equal(fields.units, old_units[source])
    counts = same.sum(0)[source - 30]
    originals = gaussians.opacities[source], gaussians.scales[source]
    expected = split_opacity_and_scale(*originals, counts)
    torch.testing.assert_close((found.opacities, found.scales), expected)
    assert counts.max() > 2 and counts.min() == 1


def test_copies_have_a_new_optimizer_state(scene):
    fields = fields_of(scene[0])
    up = {name: torch.ones_like(tensor) for name, tensor in fields.parameters.items()}
    for _ in range(5):
        fields.step(up, Rates(), 1.0)
    relocate(fields, 100, 0.25, generator())
    before = fields.parameters["logits"].clone()
    down = {name: -torch.ones_like(tensor) for name, tensor in fields.parameters.items()}
    fields.step(down, Rates(opacities=0.1), 1.0)
    moved = fields.parameters["logits"] - before
    means = fields.gaussians().means
    several = (means[:, None] == means[None]).all(-1).sum(1) > 1
    torch.testing.assert_close(moved[several], torch.full_like(moved[several], 0.1))
    assert (moved[~several] < 0).all() and several.any() and (~several).any()


def test_live_gaussians_are_sampled_by_opacity():
    opacities = torch.tensor([1e-3, 0.2, 0.6]).repeat_interleave(torch.tensor([2000, 50, 50]))
    means = torch.arange(2100.0)[:, None].repeat(1, 3)
    start = isotropic_gaussians(means, torch.ones(2100), opacities, torch.rand(2100, 3))
    fields = fields_of(start)
    relocate(fields, 2100, 0.0, generator())
    place = fields.gaussians().means[:, 0]
    assert place.min() >= 2000
    share = (place >= 2050).float().mean().item()
    assert abs(share - (0.75 * 2000 + 50) / 2100) <= 0.03


def test_without_live_gaussians_all_stay():
    start, faint = torch.rand(6, 3), torch.full((6,), 1e-6)
    start = isotropic_gaussians(start, torch.ones(6), faint, torch.rand(6, 3))
    fields = fields_of(start)
    relocate(fields, 6, 0.0, generator())
    assert torch.equal(fields.gaussians().means, start.means)
    relocate(fields, 9, 0.5, generator())
    assert fields.gaussians().validate().num_gaussians == 9


def test_the_same_generator_relocates_the_same(scene):
    found = []
    for seed in (0, 0, 1):
        fields = fields_of(scene[0])
        relocate(fields, 100, 0.25, generator(seed))
        inject_position_noise(fields, 1.0, generator(seed))
        found.append(fields.gaussians())
    assert torch.equal(found[0].means, found[1].means)
    assert torch.equal(found[0].scales, found[1].scales)
    assert not torch.equal(found[0].scales, found[2].scales)


def test_noise_has_the_shape_of_the_covariance():
    """Noise of the deviation NOISE * sigmoid(100 (0.005 - o)) * factor, times the covariance."""
    count = 4000
    quats, scales = torch.tensor([[0.8, 0.1, -0.5, 0.3]]), torch.tensor([[0.1, 0.02, 0.3]])
    colors, one = torch.rand(count, 3), torch.ones(count)
    start = isotropic_gaussians(0 * colors, one, 0.01 * one, colors)
    start = replace(start, quats=quats.repeat(count, 1), scales=scales.repeat(count, 1))
    fields = fields_of(start)
    inject_position_noise(fields, 0.5, generator())
    moved = fields.gaussians().means.double()
    gate = 1 / (1 + math.exp(-100 * (MIN_OPACITY - 0.01)))
    along = moved @ rotations(quats)[0].double()
    expected = 0.5 * NOISE * gate * scales[0].double() ** 2
    torch.testing.assert_close(along.std(0), expected, rtol=0.05, atol=0)
    correlation = torch.corrcoef(along.mT) - torch.eye(3)
    assert correlation.abs().max() <= 0.06
    assert (along.mean(0).abs() <= 4 * expected / count**0.5).all()


def test_noise_moves_only_means_of_faint_gaussians(scene):
    gaussians = scene[0]
    gaussians.opacities[:10] = 0.006
    fields = fields_of(gaussians)
    before = fields.gaussians()
    inject_position_noise(fields, 1.0, generator())
    after = fields.gaussians()
    moved = (after.means != before.means).any(-1)
    assert torch.equal(moved, torch.arange(80) < 10)
    for name in ("quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    inject_position_noise(fields, 0.0, generator())
    assert torch.equal(fields.gaussians().means, after.means)


def test_the_regularizer_is_of_the_mean_opacity_and_scale(scene):
    gaussians = scene[0].map(lambda field: field.requires_grad_())
    value = mcmc_regularizer(gaussians)
    value.backward()
    expected = REGULARIZER * (gaussians.opacities.mean() + gaussians.scales.mean())
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(gaussians.opacities.grad, torch.full((80,), REGULARIZER / 80))
    torch.testing.assert_close(gaussians.scales.grad, torch.full((80, 3), REGULARIZER / 240))
