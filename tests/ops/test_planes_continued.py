"""Depths where nothing can be matched: walls of one color, the sky, and what nothing surrounds."""

import pytest
import torch
from surfaces import cameras_at, depth_of_plane, four_cameras, texture

from asysplat.models.prior.fill import BOUND, color_edges, fill_unknown
from asysplat.models.prior.plane_sweep import plane_sweep

SIZE = 48


def slanted(slope_x=0.3, slope_y=-0.2, mean=0.5):
    y, x = torch.meshgrid(
        *2 * [torch.linspace(-0.5, 0.5, SIZE, dtype=torch.float64)], indexing="ij"
    )
    return (mean + slope_x * x + slope_y * y).expand(1, 1, -1, -1)


def test_a_wall_of_one_color_is_the_plane_that_its_border_lies_in():
    true = slanted()
    trust = torch.ones_like(true)
    trust[..., 4:-4, 4:-4] = 0
    given = true * (trust > 0)
    flat = torch.zeros(1, 1, 2, SIZE, SIZE, dtype=torch.float64)
    found = fill_unknown(given, trust, flat)
    assert (found / true - 1).abs().max() < 0.02
    # Where one side alone is known the plane goes on, at most to BOUND times what is near.
    trust[..., 16:, :] = 0
    trust[..., :16, :] = 1
    found = fill_unknown(true * trust, trust, flat)
    level = (true[..., :16, :].mean() / true - 1).abs()[..., 16:32, :].mean()
    assert (found / true - 1).abs()[..., 16:32, :].mean() < 0.3 * level
    assert found.max() <= BOUND * true.max()


def test_planes_end_at_changes_of_color_and_outliers_hardly_count():
    """The left half is twice as near as the right, and blue; one known pixel in ten is wrong."""
    true = slanted()
    true = torch.where(torch.arange(SIZE) < SIZE // 2, 2 * true, true)
    images = torch.zeros(1, 1, 3, SIZE, SIZE, dtype=torch.float64)
    images[:, :, 2, :, : SIZE // 2] = 1
    generator = torch.Generator().manual_seed(0)
    draw = torch.rand(true.shape, generator=generator)
    trust = (draw < 0.2).to(true)
    given = torch.where(draw < 0.02, 3 * true, true) * trust
    found = fill_unknown(given, trust, color_edges(images))
    unknown = trust == 0
    assert (found / true - 1).abs()[unknown].quantile(0.99) < 0.02
    blurred = fill_unknown(given, trust, color_edges(torch.zeros_like(images)))
    assert (blurred / true - 1).abs()[unknown].mean() > 5 * (found / true - 1).abs()[unknown].mean()


@pytest.mark.parametrize("known", [0, 1])
def test_what_nothing_surrounds_has_the_scenes_mean_or_0(known):
    inverse = slanted().expand(2, 3, -1, -1).clone()
    trust = torch.zeros_like(inverse)
    trust[0, 0] = known
    found = fill_unknown(inverse, trust, torch.full((2, 3, 2, SIZE, SIZE), 10.0).to(inverse))
    torch.testing.assert_close(found[0, 1:].mean(), known * inverse[0, 0].mean())
    assert not found[1].any()


def test_a_sweep_finds_a_wall_with_a_spot_of_one_color():
    cameras = four_cameras(64, 64)
    depth, points = depth_of_plane(cameras, 3.0, slant=0.3)
    images = texture(points)
    blank = (points[..., :2] - 0.15).abs().amax(-1) < 0.6
    images = torch.where(blank[:, :, None], 0.5, images)
    found = plane_sweep(images.float(), cameras.to(torch.float32))
    error = (found.inverse_depth * depth - 1).abs()
    assert blank.double().mean() > 0.1
    assert error[blank].median() < 0.02 and error[blank].quantile(0.9) < 0.05


def test_a_sky_with_faint_clouds_is_no_wall():
    """Clouds of 2 % contrast, forty times as far as the ground below them."""
    cameras = cameras_at(
        [(0.4 * (v % 3), 0.4 * (v // 3), 0.0) for v in range(6)], height=64, width=64
    )
    points, clouds = (depth_of_plane(cameras, distance)[1] for distance in (2.0, 80.0))
    sky = torch.arange(64)[:, None] < 32
    faint = 0.7 + 0.05 * (texture(clouds, scale=10.0) - 0.5)
    images = torch.where(sky, faint, texture(points))
    found = plane_sweep(images.float(), cameras.to(torch.float32)).inverse_depth
    upper, lower = found[..., :26, 8:-8], found[..., 38:, 8:-8]
    assert (lower * 2 - 1).abs().median() < 0.02
    assert upper.median() < 0.05 * lower.median() and upper.quantile(0.9) < 0.2 * lower.median()
