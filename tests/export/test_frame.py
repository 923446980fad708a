"""The frame of the viewer's pages, and their cameras."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from asysplat import Views, render
from asysplat.export.frame import (
    clicked_camera,
    distance_along,
    field_of_view,
    mean_up,
    page_camera,
    page_frame,
    quaternion,
)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_a_scene_of_any_size_looks_the_same(make_scene, factor):
    gaussians, cameras = make_scene(count=60, views=4, height=24, width=32, dtype=torch.float32)
    offset = factor * torch.tensor([30.0, -20, 10])
    scaled = gaussians.scale_by(factor)
    scaled = replace(scaled, means=scaled.means + offset)
    poses = cameras.cam_to_world.clone()
    poses[:, :3, 3] = factor * poses[:, :3, 3] + offset
    placed = replace(cameras, cam_to_world=poses)
    frame = page_frame(placed, scaled)
    inside = frame.apply(Views(placed, torch.zeros(4, 3, 24, 32))).cameras
    assert inside.centers.mean(0).norm() < 1e-4
    assert inside.centers.norm(dim=-1).max() == pytest.approx(1, abs=1e-3)
    image = render(frame.to_network(scaled), inside).image
    torch.testing.assert_close(image, render(gaussians, cameras).image, atol=2e-3, rtol=0)


def test_cameras_in_one_place_leave_the_unit_to_the_gaussians(make_scene):
    gaussians, cameras = make_scene(count=60, dtype=torch.float32)
    assert page_frame(cameras, None).scale == 1
    frame = page_frame(cameras, gaussians.scale_by(1000.0))
    assert 2000 < 1 / frame.scale < 6000


def test_up_is_the_mean_of_the_cameras(make_scene):
    _, cameras = make_scene(views=5, dtype=torch.float32)
    assert mean_up(cameras)[1] < -0.99
    assert mean_up(cameras).norm() == pytest.approx(1)
    poses = cameras.cam_to_world.clone()
    poses[1] = poses[0] @ torch.diag(torch.tensor([-1.0, -1, 1, 1]))
    opposed = replace(cameras, cam_to_world=poses).select([0, 1])
    torch.testing.assert_close(mean_up(opposed), -poses[0, :3, 1])


def test_distance_along(make_scene):
    gaussians, _ = make_scene(count=61, dtype=torch.float32)
    forward, origin = torch.tensor([0.0, 0, 1]), torch.zeros(3)
    assert distance_along(gaussians, origin, forward) == pytest.approx(3.5, abs=0.1)
    assert distance_along(gaussians, origin, -forward) == 1


def page_of(cameras, view):
    """viser's camera of a page at an input camera."""
    return SimpleNamespace(
        wxyz=quaternion(cameras, view),
        position=cameras.centers[view].numpy(),
        fov=field_of_view(cameras, view)[0],
        image_height=cameras.height,
        image_width=cameras.width,
    )


def test_a_page_at_an_input_camera(make_scene):
    _, cameras = make_scene(views=3, height=60, width=80, dtype=torch.float32)
    focal = torch.tensor([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]])
    cameras = replace(cameras, intrinsics=focal.repeat(3, 1, 1))
    for view in range(3):
        camera, in_full = page_camera(page_of(cameras, view), 60 * 80)
        assert in_full and (camera.height, camera.width) == (60, 80)
        torch.testing.assert_close(camera.intrinsics[0], focal)
        torch.testing.assert_close(camera.cam_to_world[0], cameras.cam_to_world[view])
    assert field_of_view(cameras, 0)[1] == pytest.approx(80 / 60)


def test_fewer_pixels_keep_the_field_of_view(make_scene):
    _, cameras = make_scene(height=600, width=800, dtype=torch.float32)
    camera, in_full = page_camera(page_of(cameras, 0), 30_000)
    assert not in_full and (camera.height, camera.width) == (150, 200)
    expected = 2 * math.atan(75 / camera.intrinsics[0, 1, 1].item())
    assert expected == pytest.approx(field_of_view(cameras, 0)[0])


def test_a_click_hits_the_first_visible_image(make_scene):
    _, cameras = make_scene(views=3, height=60, width=80, dtype=torch.float32)
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 2, 3] = torch.tensor([0.0, 1, 2])  # one behind the other, looking ahead
    cameras = replace(cameras, cam_to_world=poses)
    start, ahead = torch.zeros(3), torch.tensor([0.01, 0.01, 1])
    assert clicked_camera(cameras, 0.1, start, 0.01 * ahead) == 0
    assert clicked_camera(cameras, 0.1, start, 0.15 * ahead) == 1
    assert clicked_camera(cameras, 0.1, start, 1.15 * ahead) == 2
    assert clicked_camera(cameras, 0.1, torch.tensor([0.0, 0, 5]), -0.01 * ahead) == 2
    assert clicked_camera(cameras, 0.1, start, -0.01 * ahead) is None
    assert clicked_camera(cameras, 0.1, torch.tensor([0.2, 0, 0]), 0.01 * ahead) is None
    # 0.1 * 80 / 80 wide: 0.05 to each side.
    for x, met in ((0.049, 0), (0.051, None)):
        ray = torch.tensor([0, 0, 0.01])
        assert clicked_camera(cameras, 0.1, torch.tensor([x, 0, 0]), ray) == met
