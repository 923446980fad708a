"""A path around what cameras look at, and only where they have been."""

import math

import numpy as np
import pytest
import torch
from placed import HARD, cameras_at, ring

from asysplat.export import orbit
from asysplat.scene import Cameras


def assert_looks_at(cameras: Cameras, point, atol=1e-4):
    ahead = torch.tensor(point) - cameras.centers
    ahead = torch.nn.functional.normalize(ahead, dim=-1)
    torch.testing.assert_close(cameras.cam_to_world[:, :3, 2], ahead.float(), rtol=0, atol=atol)


def test_cameras_all_around_are_circled():
    made = orbit(cameras_at(ring(range(0, 360, 20)), np.zeros((18, 3))), 36)
    assert_looks_at(made, (0.0, 0, 0))
    torch.testing.assert_close(made.centers[:, :2].norm(dim=-1), torch.full((36,), 2.0))
    torch.testing.assert_close(made.centers[:, 2], torch.full((36,), 0.5))
    # Closed: from the last frame to the first it is as far as between any others.
    around = torch.cat((made.centers, made.centers[:1])).diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(around, torch.full((36,), 4 * math.sin(math.radians(5))))
    assert (made.cam_to_world[:, 2, 1] < 0).all()  # upright: down is down


@pytest.mark.parametrize("start", [0, 150, 300])
def test_cameras_on_one_side_are_not_left(start):
    angles = np.arange(start, start + 81, 10)
    made = orbit(cameras_at(ring(angles, height=1.5), np.zeros((9, 3))), 40)
    assert_looks_at(made, (0.0, 0, 0))
    # Level, though all cameras look down by 37 degrees to the same side.
    torch.testing.assert_close(made.centers[:, 2], torch.full((40,), 1.5))
    assert made.cam_to_world[:, 2, 0].abs().max() < 1e-4
    x, y = made.centers[:, :2].double().numpy().T
    seen = (np.degrees(np.arctan2(y, x)) - start + 180) % 360 - 180
    np.testing.assert_allclose((seen.min(), seen.max()), (0, 80), atol=0.1)
    np.testing.assert_allclose(np.hypot(x, y), 2, rtol=1e-4)
    # To and fro, without a jump from the last frame to the first.
    assert np.abs(np.diff(seen, append=seen[0])).max() < 8


def test_parallel_axes_swing_in_front_of_the_middle_camera():
    cameras = cameras_at([[x, 0, 1] for x in (-2, -1, 0, 1, 2)])
    made = orbit(cameras, 20)
    assert made.centers[:, 0].abs().max() < 2.1
    assert made.centers[:, 0].abs().max() > 0.5
    assert made.cam_to_world[:, 1, 2].min() > math.cos(math.radians(25))
    torch.testing.assert_close(made.centers[:, 2], torch.ones(20))


@pytest.mark.parametrize("case", ["outwards", "one place, all around", "one"])
def test_where_no_point_is_seen_by_most_the_middle_camera_swings_a_little(case):
    made = orbit(HARD[case], 20)
    axes = made.cam_to_world[:, :3, 2]
    assert (axes @ axes.mT).min() > math.cos(math.radians(10.1))
    assert (axes @ axes.mT).min() < math.cos(math.radians(9))
    seen = torch.cat((HARD[case].cam_to_world[:, :3, 2], axes))
    assert (seen[:-20] @ axes.mT).max() > math.cos(math.radians(0.5))
