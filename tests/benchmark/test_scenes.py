"""The scenes are what their docstrings say."""

import math

import pytest
import torch

from benchmarks.scenes import ARC, DISTANCE, pixel_aligned_scene, place_on_arc, random_scene


@pytest.mark.parametrize("make, count, num", [(random_scene, 9, 9), (pixel_aligned_scene, 20, 800)])
def test_scenes_are_valid_and_visible(make, count, num):
    gaussians, cameras = make(count, 54, 96)
    gaussians.validate()
    cameras.validate()
    assert gaussians.num_gaussians == num
    assert (cameras.num_views, cameras.height, cameras.width) == (1, 54, 96)
    _, _, inside = cameras.project(gaussians.means)
    assert inside.float().mean() > 0.6


def test_cameras_on_an_arc_look_at_its_middle():
    _, camera = pixel_aligned_scene(2, 54, 96)
    cameras = place_on_arc(camera, 5)
    cameras.validate()
    assert cameras.num_views == 5
    middle = torch.tensor([0, 0, DISTANCE, 1])
    in_cameras = torch.linalg.inv(cameras.cam_to_world) @ middle
    torch.testing.assert_close(in_cameras, middle.expand(5, 4), rtol=0, atol=1e-5)
    first, last = cameras.cam_to_world[0, :3, 2], cameras.cam_to_world[-1, :3, 2]
    assert (first @ last).item() == pytest.approx(math.cos(ARC), abs=1e-6)
    torch.testing.assert_close(cameras.cam_to_world[2], camera.cam_to_world[0])
