"""Densification by errors: new Gaussians at wrong pixels, with position, color and size."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.refinement.densification.spawn import (
    SPAWN_OPACITY,
    SPAWN_SIZE,
    render_views,
    spawn_at_errors,
)
from asysplat.refinement.isotropic import isotropic_gaussians
from asysplat.rendering import render
from asysplat.rendering.sh import SH_C0
from asysplat.scene import Views


@pytest.fixture(scope="module")
def room():
    return ProceduralScene(1, 24, 32, 12, places="rooms").views(range(0, 12, 3))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def wrong_in(views, view, rows, columns):
    """Pictures that are black there, and the photographs elsewhere."""
    rendered = views.images.clone()
    rendered[view, :, rows, columns] = 0
    return rendered


def test_position_color_and_size(room):
    rows, columns = slice(10, 14), slice(20, 28)
    rendered = wrong_in(room, 2, rows, columns)
    found = spawn_at_errors(room, rendered, room.depths, 40, generator()).validate()
    assert found.num_gaussians == 40
    camera = room.cameras.select([2])
    (pixels,), (depth,), _ = camera.project(found.means)
    column, row = pixels.long().unbind(-1)
    assert (pixels - pixels.floor() - 0.5).abs().max() <= 1e-3  # at their centers
    # An error is averaged over 3 x 3 pixels.
    assert row.min() >= 9 and row.max() <= 14 and column.min() >= 19 and column.max() <= 28
    assert ((row == 9) | (row == 14) | (column == 19) | (column == 28)).any()
    torch.testing.assert_close(depth, room.depths[2, row, column], rtol=1e-4, atol=0)
    torch.testing.assert_close(
        found.sh[:, 0] * SH_C0 + 0.5, room.images[2, :, row, column].mT, rtol=0, atol=1e-6
    )
    sizes = SPAWN_SIZE * depth / camera.intrinsics[0, 0, 0]
    torch.testing.assert_close(found.scales, sizes[:, None].repeat(1, 3))
    assert (found.opacities == SPAWN_OPACITY).all()
    assert len(torch.unique(row * 32 + column)) == 40  # each pixel once


def test_samples_are_proportional_to_errors(room):
    rendered = room.images.clone()
    rendered[0, :, :, :16] += 0.3
    rendered[0, :, :, 16:] += 0.1
    rendered[1:, :, :, 16:] += 0.1
    chosen = [
        spawn_at_errors(room, rendered, torch.ones_like(room.depths), 20, generator(seed))
        for seed in range(40)
    ]
    every = torch.cat([each.means for each in chosen])
    local = (every - room.cameras.centers[0]) @ room.cameras.cam_to_world[0, :3, :3]
    in_first = (local[:, 2] - 1).abs() <= 1e-4
    left = in_first & (local[:, 0] < 0)
    # Pictures of 2 x 384 pixels with errors of 0.3 and 0.1, and three with 384 of 0.1: 3 in 7.
    assert abs(left.float().mean().item() - 3 / 7) <= 0.06


def test_none_without_an_error_or_at_the_background(room):
    rendered = wrong_in(room, 1, slice(4, 6), slice(4, 6))
    assert spawn_at_errors(room, rendered, room.depths, 500, generator()).num_gaussians == 16
    depth = room.depths.clone()
    depth[1, :5] = 0
    assert spawn_at_errors(room, rendered, depth, 500, generator()).num_gaussians == 8
    for right, none in ((room.images, room.depths), (rendered, torch.zeros_like(depth))):
        found = spawn_at_errors(room, right, none, 500, generator())
        assert found.num_gaussians == 0 and found.sh.shape == (0, 1, 3)


def test_masked_pixels_are_not_sampled(room):
    masks = torch.ones_like(room.depths, dtype=torch.bool)
    masks[:, :, 8:] = False
    views = replace(room, masks=masks)
    rendered = torch.zeros_like(room.images)
    found = spawn_at_errors(views, rendered, room.depths, 10_000, generator())
    assert found.num_gaussians == 4 * 24 * 8
    nothing = replace(room, masks=torch.zeros_like(masks))
    assert not spawn_at_errors(nothing, rendered, room.depths, 9, generator()).num_gaussians


def test_the_same_generator_draws_the_same(room, threads):
    views = Views(room.cameras.resized(150, 200), torch.rand(4, 3, 150, 200))
    found = []
    for count, seed in ((1, 0), (2, 0), (1, 1)):
        threads(count)
        black, depth = torch.zeros_like(views.images), torch.ones(4, 150, 200)
        found.append(spawn_at_errors(views, black, depth, 50, generator(seed)).means)
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 2)], ids=str)
def test_tiny_images(room, size):
    views = Views(room.cameras.resized(*size), torch.rand(4, 3, *size))
    found = spawn_at_errors(views, 0 * views.images, torch.ones(4, *size), 3, generator())
    assert found.validate().num_gaussians == 3


def test_render_views(room):
    """A wall of opaque Gaussians before the second camera alone."""
    x = torch.linspace(-0.5, 0.5, 21)
    plane = torch.stack((*torch.meshgrid(x, x, indexing="ij"), 2 + torch.zeros(21, 21)), -1)
    pose = room.cameras.cam_to_world[1]
    means = plane.flatten(0, 1) @ pose[:3, :3].mT + pose[:3, 3]
    many = torch.ones(441)
    wall = isotropic_gaussians(means, 0.1 * many, 0.9 * many, torch.rand(441, 3))
    background = torch.tensor([0.2, 0.4, 0.6])
    images, depths = render_views(wall, room, background)
    assert images.shape == room.images.shape and depths.shape == room.depths.shape
    assert not images.requires_grad
    for view in range(4):
        alone = render(wall, room.cameras.select([view]), background, depth="median")
        assert torch.equal(images[view], alone.image[0])
        assert torch.equal(depths[view], alone.depth[0])
    torch.testing.assert_close(depths[1, 12, 16], torch.tensor(2.0), rtol=1e-3, atol=0)
    assert (depths[1, 0, 0] == 0) and torch.equal(images[1, :, 0, 0], background)
