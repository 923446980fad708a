"""Epipolar distances and triangulation on known answers."""

from dataclasses import replace

import pytest
import torch

from asysplat.data.check.matches import Matches, epipolar_distances, epipolar_lines, triangulate
from asysplat.scene import Cameras

HEIGHT, WIDTH = 120, 160


@pytest.fixture
def cameras() -> Cameras:
    skew = 0.1 * torch.randn(4, 3, 3).double()
    poses = torch.eye(4).double().repeat(4, 1, 1)
    poses[:, :3, :3] = torch.linalg.matrix_exp(skew - skew.mT)
    poses[:, :3, 3] = torch.randn(4, 3)
    intrinsics = torch.tensor([[150.0, 0, 82], [0, 140, 57], [0, 0, 1]]).double()
    return Cameras(intrinsics.repeat(4, 1, 1), poses, HEIGHT, WIDTH)


def project(cameras, view, points):
    """Pixels and depths."""
    pose, lens = cameras.cam_to_world[view], cameras.intrinsics[view]
    in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
    pixels = in_camera @ lens.T
    return pixels[:, :2] / pixels[:, 2:], in_camera[:, 2]


def seen(cameras, first, second, points):
    pixels, depths = zip(*(project(cameras, view, points) for view in (first, second)), strict=True)
    frames = torch.tensor([[first, second]]).repeat(len(points), 1)
    return Matches(frames, torch.stack(pixels, 1)), torch.stack(depths, 1)


@pytest.fixture
def points():
    return torch.randn(30, 3).double() + torch.tensor([0, 0, 9])


def test_true_matches_lie_on_their_epipolar_lines_and_triangulate_to_their_depths(cameras, points):
    for sign in (1, -1):  # in front of the cameras, and behind
        matches, depths = seen(cameras, 3, 1, sign * points)
        assert (depths.sign() == sign).all()
        assert epipolar_distances(cameras, matches).max() < 1e-9
        found, angles = triangulate(cameras, matches)
        torch.testing.assert_close(found, depths)
        rays = sign * points[:, None] - cameras.centers[[3, 1]]
        cosine = torch.nn.functional.cosine_similarity(rays[:, 0], rays[:, 1], dim=-1)
        expected = torch.rad2deg(torch.arccos(cosine))
        torch.testing.assert_close(angles, expected)
    poses = cameras.cam_to_world.clone()
    poses[:, :3, 3] = 5  # one place has no epipolar lines
    assert epipolar_distances(replace(cameras, cam_to_world=poses), matches).isinf().all()


def test_epipolar_distances_are_in_pixels(cameras, points):
    matches, _ = seen(cameras, 0, 2, points)
    lines = epipolar_lines(cameras, matches)
    moved = matches.points.clone()
    # Across the line in the second view, which leaves that line where it is.
    moved[:, 1] += 3 * lines[:, 1, :2]
    moved = replace(matches, points=moved)
    second = epipolar_lines(cameras, moved)[:, 1]
    distance = (second[:, :2] * moved.points[:, 1]).sum(-1) + second[:, 2]
    torch.testing.assert_close(distance.abs(), torch.full_like(distance, 3))
    first = epipolar_lines(cameras, moved)[:, 0]
    other = ((first[:, :2] * moved.points[:, 0]).sum(-1) + first[:, 2]).abs()
    torch.testing.assert_close(epipolar_distances(cameras, moved), (3 + other) / 2)
