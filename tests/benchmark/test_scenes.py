"""The scenes are what their docstrings say."""

import math

import pytest
import torch

from asysplat.benchmark.scenes import (
    ARC,
    DISTANCE,
    FOCAL,
    on_an_arc,
    pixel_aligned_scene,
    random_scene,
)


def in_pixels(gaussians, cameras):
    """Where the Gaussians are in the image, and their deviations."""
    depths = gaussians.means[:, 2:]
    focal = FOCAL * cameras.width
    middle = torch.tensor([cameras.width / 2, cameras.height / 2])
    return gaussians.means[:, :2] / depths * focal + middle, gaussians.scales * focal / depths


def test_random_scene():
    gaussians, cameras = random_scene(50_000, 54, 96)
    gaussians.validate()
    cameras.validate()
    assert gaussians.num_gaussians == 50_000
    assert (cameras.num_views, cameras.height, cameras.width) == (1, 54, 96)
    centers, deviations = in_pixels(gaussians, cameras)
    share = centers / torch.tensor([96, 54])
    assert -0.101 < share.min() < -0.099 and 1.099 < share.max() < 1.101
    assert deviations.median().item() == pytest.approx(2, rel=0.01)
    assert deviations.log().std().item() == pytest.approx(0.6, rel=0.01)
    for values, low, high in ((gaussians.means[:, 2], 2, 10), (gaussians.opacities, 0.05, 0.95)):
        quarters = values.quantile(torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]))
        uniform = torch.linspace(low, high, 5)
        torch.testing.assert_close(quarters, uniform, rtol=0, atol=0.02 * (high - low))


def test_pixel_aligned_scene():
    gaussians, cameras = pixel_aligned_scene(100, 54, 96)
    gaussians.validate()
    cameras.validate()
    assert gaussians.num_gaussians == 2 * 100**2
    centers, deviations = in_pixels(gaussians, cameras)
    assert deviations.median().item() == pytest.approx(0.8 * 96 / 100, rel=0.01)
    assert deviations.log().std().item() == pytest.approx(0.4, rel=0.02)
    assert gaussians.opacities.logit().std().item() == pytest.approx(2, rel=0.02)
    assert ((gaussians.means[:, 2] - DISTANCE).abs() < 0.6).all()
    # Twice one in each cell of the grid, row by row; rounding may cross an edge.
    column, row = (centers / torch.tensor([96, 54]) * 100).unbind(-1)
    index = torch.arange(2 * 100**2) % 100**2
    inside = torch.stack((column - index % 100, row - index // 100))
    assert inside.min() > -1e-3 and inside.max() < 1 + 1e-3


def test_cameras_on_an_arc_look_at_its_middle():
    _, camera = pixel_aligned_scene(2, 54, 96)
    cameras = on_an_arc(camera, 5)
    cameras.validate()
    assert cameras.num_views == 5
    middle = torch.tensor([0, 0, DISTANCE, 1])
    in_cameras = torch.linalg.inv(cameras.cam_to_world) @ middle
    torch.testing.assert_close(in_cameras, middle.expand(5, 4), rtol=0, atol=1e-5)
    first, last = cameras.cam_to_world[0, :3, 2], cameras.cam_to_world[-1, :3, 2]
    assert (first @ last).item() == pytest.approx(math.cos(ARC), abs=1e-6)
    torch.testing.assert_close(cameras.cam_to_world[2], camera.cam_to_world[0])
