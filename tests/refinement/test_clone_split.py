"""Densification of 3DGS: clone and split by screen-space gradients."""

from dataclasses import replace

import torch

from asysplat.refinement.densification.clone_split import (
    DENSIFY_GRAD_THRESHOLD,
    SPLIT_FACTOR,
    SPLIT_SCALE,
    ScreenGradients,
)
from asysplat.refinement.densification.spawn import MIN_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.refinement.isotropic import isotropic_gaussians
from asysplat.rendering import render
from asysplat.scene import Cameras

COUNT = 6


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def camera():
    intrinsics = torch.tensor([[[40.0, 0, 24], [0, 50, 16], [0, 0, 1]]])
    return Cameras(intrinsics, torch.eye(4)[None], height=32, width=48)


def gaussians(size=SPLIT_SCALE / 2, count=COUNT):
    means = torch.tensor([[0.0, 0.0, 2.0]]) + torch.arange(count)[:, None] * 0.1
    colors = torch.linspace(0, 1, 3 * count).reshape(count, 3)
    return isotropic_gaussians(means, torch.full((count,), size), torch.full((count,), 0.5), colors)


def fields_of(start):
    return Fields(start, torch.linspace(0.5, 2, start.num_gaussians))


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
    assert len(fields) == COUNT + 1
    assert screen.mean.shape == (COUNT + 1,) and not screen.mean.any()  # reset
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(after, name)[:COUNT], getattr(before, name))
        torch.testing.assert_close(getattr(after, name)[COUNT], getattr(before, name)[3])


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


def test_the_limit_and_the_largest_gradients_first():
    fields = fields_of(gaussians())
    before = fields.gaussians()
    with_gradients(fields, 4, 2, 0).clone_and_split(COUNT + 1, generator())
    assert len(fields) == COUNT + 1
    torch.testing.assert_close(fields.gaussians().means[-1], before.means[4])


def test_transparent_gaussians_are_pruned_but_one():
    start = gaussians()
    faint = torch.full((COUNT,), MIN_OPACITY / 2)
    some = faint.clone()
    some[2] = 0.9
    for opacities, left in ((some, 2), (faint, 0)):
        fields = fields_of(replace(start, opacities=opacities))
        ScreenGradients(fields).clone_and_split(100, generator())
        torch.testing.assert_close(fields.gaussians().means, start.means[left, None])
