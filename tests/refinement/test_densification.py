"""Densification: by rendering errors, by 3DGS-MCMC, and by cloning and splitting."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.geometry.isotropic import isotropic_gaussians
from asysplat.geometry.motion import rotations
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.refinement.densification.clone_split import (
    DENSIFY_GRAD_THRESHOLD,
    MAX_SCALE,
    SPLIT_FACTOR,
    SPLIT_SCALE,
    ScreenGradients,
)
from asysplat.refinement.densification.relocate import (
    MAX_COPIES,
    NOISE,
    inject_position_noise,
    relocate,
    split_opacity_and_scale,
)
from asysplat.refinement.densification.spawn import (
    MIN_OPACITY,
    SPAWN_OPACITY,
    SPAWN_SIZE,
    spawn_at_errors,
)
from asysplat.refinement.fields import Fields
from asysplat.refinement.settings import DEFAULT
from asysplat.rendering import render
from asysplat.scene import Cameras


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def fields_of(gaussians):
    return Fields(gaussians, torch.linspace(0.5, 2, gaussians.num_gaussians))


@pytest.fixture
def scene(make_scene):
    return make_scene(count=80, height=40, width=52, dtype=torch.float32)


def wrong_in(views, view, rows, columns):
    """Pictures that are black there, and the photographs elsewhere."""
    rendered = views.images.clone()
    rendered[view, :, rows, columns] = 0
    return rendered


def test_spawned_gaussians_have_position_color_and_size_of_wrong_pixels(small_room):
    rows, columns = slice(10, 14), slice(20, 28)
    rendered = wrong_in(small_room, 2, rows, columns)
    found = spawn_at_errors(small_room, rendered, small_room.depths, 40, generator()).validate()
    assert found.num_gaussians == 40
    camera = small_room.cameras.select([2])
    (pixels,), (depth,), _ = camera.project(found.means)
    column, row = pixels.long().unbind(-1)
    assert (pixels - pixels.floor() - 0.5).abs().max() <= 1e-3  # at their centers
    # An error is averaged over 3 x 3 pixels.
    assert row.min() >= 9 and row.max() <= 14 and column.min() >= 19 and column.max() <= 28
    assert ((row == 9) | (row == 14) | (column == 19) | (column == 28)).any()
    torch.testing.assert_close(depth, small_room.depths[2, row, column], rtol=1e-4, atol=0)
    colors = found.sh[:, 0] * SH_C0 + 0.5
    expected = small_room.images[2, :, row, column].mT
    torch.testing.assert_close(colors, expected, rtol=0, atol=1e-6)
    sizes = SPAWN_SIZE * depth / camera.intrinsics[0, 0, 0]
    torch.testing.assert_close(found.scales, sizes[:, None].repeat(1, 3))
    assert (found.opacities == SPAWN_OPACITY).all()
    assert len(torch.unique(row * 32 + column)) == 40  # each pixel once


def test_spawning_samples_pixels_in_proportion_to_their_errors(small_room):
    rendered = small_room.images.clone()
    rendered[0, :, :, :16] += 0.3
    rendered[0, :, :, 16:] += 0.1
    rendered[1:, :, :, 16:] += 0.1
    depth, seeds = torch.ones_like(small_room.depths), map(generator, range(40))
    chosen = [spawn_at_errors(small_room, rendered, depth, 20, seed) for seed in seeds]
    every = torch.cat([each.means for each in chosen])
    local = (every - small_room.cameras.centers[0]) @ small_room.cameras.cam_to_world[0, :3, :3]
    in_first = (local[:, 2] - 1).abs() <= 1e-4
    left = in_first & (local[:, 0] < 0)
    # Pictures of 2 x 384 pixels with errors of 0.3 and 0.1, and three with 384 of 0.1: 3 in 7.
    assert abs(left.float().mean().item() - 3 / 7) <= 0.06


def test_nothing_is_spawned_without_an_error_or_at_the_background(small_room):
    images, depths = small_room.images, small_room.depths
    rendered, below = wrong_in(small_room, 1, slice(4, 6), slice(4, 6)), depths.clone()
    below[1, :5] = 0
    for image, depth, count in ((rendered, depths, 16), (rendered, below, 8), (images, depths, 0)):
        found = spawn_at_errors(small_room, image, depth, 500, generator())
        assert found.num_gaussians == count and found.sh.shape == (count, 1, 3)


def test_nothing_is_spawned_at_masked_pixels(small_room):
    masks = torch.ones_like(small_room.depths, dtype=torch.bool)
    masks[:, :, 8:] = False
    views = replace(small_room, masks=masks)
    rendered = torch.zeros_like(small_room.images)
    found = spawn_at_errors(views, rendered, small_room.depths, 10_000, generator())
    assert found.num_gaussians == 4 * 24 * 8
    nothing = replace(small_room, masks=torch.zeros_like(masks))
    assert not spawn_at_errors(nothing, rendered, small_room.depths, 9, generator()).num_gaussians


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


@pytest.mark.parametrize("count", [1, 2, MAX_COPIES])
def test_opacities_and_scales_of_copies_follow_equation_9(count):
    opacities, scales = torch.linspace(0.3, 0.99, 7), torch.rand(7, 3)
    found, sizes = split_opacity_and_scale(opacities, scales, torch.full((7,), count))
    exact = (1 - (1 - opacities.double()) ** (1 / count)).float().clamp_min(MIN_OPACITY)
    torch.testing.assert_close(found, exact)
    factors = torch.tensor([double_sum(opacity, count) for opacity in opacities.tolist()])
    torch.testing.assert_close(sizes, scales * factors[:, None], rtol=1e-4, atol=0)
    if count == 1:
        torch.testing.assert_close((found, sizes), (opacities, scales))
    if count == MAX_COPIES:  # more count as that many
        opacities[0] = 1.0
        most = split_opacity_and_scale(opacities, scales, torch.full((7,), count))
        more = split_opacity_and_scale(opacities, scales, torch.full((7,), 1000))
        assert torch.equal(more[0], most[0]) and torch.equal(more[1], most[1])
        assert more[0].isfinite().all() and (more[1] > 0).all() and more[1].isfinite().all()


@pytest.mark.parametrize("dead", [1, 40])
def test_the_image_stays_where_dead_gaussians_move(scene, dead):
    gaussians, cameras = scene
    gaussians.opacities[:dead] = MIN_OPACITY / 2
    fields = fields_of(gaussians)
    before = draw(gaussians, cameras)
    relocate(fields, 80, generator())
    found = fields.gaussians().validate()
    assert found.num_gaussians == 80
    assert (found.opacities > MIN_OPACITY).all()
    assert not torch.equal(found.opacities, gaussians.opacities)
    assert (draw(found, cameras) - before).abs().mean() <= 1e-2
    uncorrected = gaussians.map(lambda field: torch.cat((field[40:], field[40:])))
    assert dead < 40 or (draw(uncorrected, cameras) - before).abs().mean() > 2e-2


def test_copies_are_added_up_to_the_limit_and_the_image_stays(scene):
    gaussians, cameras = scene
    for target in (20, 80, 84, 120):
        fields = fields_of(gaussians)
        relocate(fields, target, generator())
        assert len(fields) == max(target, 80)
        difference = draw(fields.gaussians(), cameras) - draw(gaussians, cameras)
        assert difference.abs().mean() <= 1e-2


def test_copies_have_the_fields_of_their_original(scene):
    gaussians = scene[0]
    gaussians.opacities[:30] = MIN_OPACITY / 2
    fields = fields_of(gaussians)
    old_units = fields.units
    relocate(fields, 80, generator())
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


def test_copies_have_a_new_optimizer_state_and_others_keep_theirs(scene):
    fields = fields_of(scene[0])
    up = {name: torch.ones_like(tensor) for name, tensor in fields.parameters.items()}
    for _ in range(5):
        fields.step(up, DEFAULT.rates, 1.0)
    relocate(fields, 100, generator())
    before = fields.parameters["logits"].clone()
    down = {name: -torch.ones_like(tensor) for name, tensor in fields.parameters.items()}
    fields.step(down, replace(DEFAULT.rates, opacities=0.1), 1.0)
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
    relocate(fields, 2100, generator())
    place = fields.gaussians().means[:, 0]
    assert place.min() >= 2000
    share = (place >= 2050).float().mean().item()
    assert abs(share - (0.75 * 2000 + 50) / 2100) <= 0.03


def test_relocation_without_live_gaussians_moves_none():
    start, faint = torch.rand(6, 3), torch.full((6,), 1e-6)
    start = isotropic_gaussians(start, torch.ones(6), faint, torch.rand(6, 3))
    fields = fields_of(start)
    relocate(fields, 6, generator())
    assert torch.equal(fields.gaussians().means, start.means)
    relocate(fields, 9, generator())
    assert fields.gaussians().validate().num_gaussians == 9


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


def camera():
    intrinsics = torch.tensor([[[40.0, 0, 24], [0, 50, 16], [0, 0, 1]]])
    return Cameras(intrinsics, torch.eye(4)[None], height=32, width=48)


def gaussians(size=SPLIT_SCALE / 2, count=6):
    means = torch.tensor([[0.0, 0.0, 2.0]]) + torch.arange(count)[:, None] * 0.1
    colors = torch.linspace(0, 1, 3 * count).reshape(count, 3)
    return isotropic_gaussians(means, torch.full((count,), size), torch.full((count,), 0.5), colors)


def with_gradients(fields, *rows):
    """Return gradients above the threshold for `rows`, the first the largest."""
    screen = ScreenGradients(fields)
    # At distance 2 to 2.5 and focal length 40 this is 2.4 or more of half an image.
    gradients = torch.zeros(len(fields), 3)
    for rank, row in enumerate(rows):
        gradients[row, 0] = fields.units[row] * DENSIFY_GRAD_THRESHOLD * (len(rows) - rank)
    screen.add(gradients, camera())
    return screen


def test_screen_gradients_are_those_of_the_position_in_the_image():
    """With one Gaussian, that of the principal point, times half the image's sides."""
    start = gaussians(size=0.1, count=1)
    fields, cameras = fields_of(start), camera()
    intrinsics = cameras.intrinsics.requires_grad_()
    target = torch.rand(1, 3, 32, 48, generator=generator())
    leaves = fields.leaves()
    image = render(fields.gaussians(leaves), cameras, depth=False).image
    error = (image - target).abs().mean()
    of_pixels, of_offsets = torch.autograd.grad(error, (intrinsics, leaves["offsets"]))
    screen = ScreenGradients(fields)
    screen.add(of_offsets, camera())
    expected = (of_pixels[0, :2, 2] * torch.tensor([24.0, 16.0])).norm()
    assert expected > 1e-5
    torch.testing.assert_close(screen.mean, expected[None], rtol=1e-3, atol=0)
    screen.add(torch.zeros(1, 3), camera())  # is not visible in another view
    torch.testing.assert_close(screen.mean, expected[None], rtol=1e-3, atol=0)


def test_small_gaussians_are_cloned_in_place():
    fields = fields_of(gaussians())
    before = fields.gaussians()
    screen = with_gradients(fields, 3)
    assert screen.mean[3] > DENSIFY_GRAD_THRESHOLD and screen.mean.count_nonzero() == 1
    screen.clone_and_split(100, generator())
    after = fields.gaussians()
    assert len(fields) == 7
    assert screen.mean.shape == (7,) and not screen.mean.any()  # reset
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(after, name)[:6], getattr(before, name))
        torch.testing.assert_close(getattr(after, name)[6], getattr(before, name)[3])


def test_large_gaussians_are_split_in_two_smaller_ones():
    fields = fields_of(gaussians(size=2 * SPLIT_SCALE, count=200))
    before = fields.gaussians()
    with_gradients(fields, *range(100)).clone_and_split(1000, generator())
    after = fields.gaussians()
    assert len(fields) == 300
    torch.testing.assert_close(after.means[:100], before.means[100:])
    halves = after.map(lambda field: field[100:])
    torch.testing.assert_close(halves.scales, torch.full((200, 3), 2 * SPLIT_SCALE / SPLIT_FACTOR))
    colors = torch.cdist(halves.sh[:, 0], before.sh[:, 0])
    away = halves.means - before.means[colors.argmin(1)]  # of the one with the same
    assert 0.8 < away.std() / (2 * SPLIT_SCALE) < 1.2


def test_cloning_stops_at_the_limit_and_takes_the_largest_gradients_first():
    fields = fields_of(gaussians())
    before = fields.gaussians()
    with_gradients(fields, 4, 2, 0).clone_and_split(7, generator())
    assert len(fields) == 7
    torch.testing.assert_close(fields.gaussians().means[-1], before.means[4])


def test_large_gaussians_are_pruned_after_an_opacity_reset():
    """Too large in the world, or in the image: three deviations in more than 20 pixels."""
    start = gaussians(size=0.01)
    start.scales[1, 2] = 2 * MAX_SCALE
    start.means[4, 2] = 0.04  # 30 pixels at focal length 40
    kept = [0, 2, 3, 5]
    for prune_large, expected in ((True, start.means[kept]), (False, start.means)):
        fields = fields_of(start)
        screen = ScreenGradients(fields)
        screen.add(torch.full((6, 3), 1e-9), camera())
        screen.clone_and_split(100, generator(), prune_large)
        torch.testing.assert_close(fields.gaussians().means, expected)


def test_transparent_gaussians_are_pruned_but_one():
    start = gaussians()
    faint = torch.full((6,), MIN_OPACITY / 2)
    some = faint.clone()
    some[2] = 0.9
    for opacities, left in ((some, 2), (faint, 0)):
        fields = fields_of(replace(start, opacities=opacities))
        ScreenGradients(fields).clone_and_split(100, generator())
        torch.testing.assert_close(fields.gaussians().means, start.means[left, None])
