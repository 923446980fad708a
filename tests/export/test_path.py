"""A path along the cameras' own: smooth, at constant speed, where cameras were."""

import math

import numpy as np
import pytest
import torch
from placed import cameras_at, ring, turned
from scipy.spatial.transform import Rotation

from asysplat.export import smoothed_path
from asysplat.scene import Cameras


def steps(cameras: Cameras) -> np.ndarray:
    return cameras.centers.diff(dim=0).norm(dim=-1).numpy()


def turns(cameras: Cameras) -> np.ndarray:
    """Degrees from each camera to the next."""
    rotations = Rotation.from_matrix(cameras.cam_to_world[:, :3, :3].numpy())
    return np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude())


def test_a_walk_is_smooth_even_and_where_the_cameras_were():
    rng = np.random.default_rng(0)
    # Steps of all lengths along half a circle, with tremble.
    angles = np.sort(rng.uniform(0, 180, 200))
    angles[[0, -1]] = 0, 180
    still = cameras_at(ring(angles), np.zeros((200, 3)))
    trembling = still.centers.double().numpy() + rng.normal(scale=0.01, size=(200, 3))
    made = smoothed_path(cameras_at(trembling, rng.normal(scale=0.02, size=(200, 3))), 120)
    distance = made.centers[:, :2].norm(dim=-1)
    assert (distance - 2).abs().max() < 0.02
    assert (made.centers[0] - still.centers[0]).norm() < 0.2
    assert (made.centers[-1] - still.centers[-1]).norm() < 0.2
    # In spreads and radians.
    spread = still.centers.std(dim=0, correction=0).norm().item()
    speed = np.hypot(steps(made) / spread, np.radians(turns(made)))
    assert speed.max() < 1.05 * speed.min()
    # The angle between one step and the next is that of the circle.
    way = torch.nn.functional.normalize(made.centers.diff(dim=0), dim=-1)
    bends = torch.rad2deg(torch.acos((way[1:] * way[:-1]).sum(-1).clamp(-1, 1)))
    assert bends.max() < 4 and 1 < bends.mean() < 2


def test_few_views_are_passed_through():
    cameras = cameras_at(ring(range(0, 181, 30)), np.zeros((7, 3)))
    made = smoothed_path(cameras, 200)
    nearest = torch.cdist(cameras.centers, made.centers).min(1).values
    assert nearest[1:-1].max() < 0.03 and nearest.max() < 0.12
    assert (made.centers[:, :2].norm(dim=-1) - 2).abs().max() < 0.05
    inwards = -torch.nn.functional.normalize(made.centers, dim=-1)
    assert (inwards * made.cam_to_world[:, :3, 2]).sum(-1).min() > math.cos(math.radians(2))
    made = smoothed_path(cameras_at([[0, 0, 0], [1, 0, 0]]), 11)  # a line
    assert (made.centers[:, 1:] == 0).all()
    assert (made.centers[:, 0].diff() > 0).all()
    assert made.centers[0, 0] < 0.05 and made.centers[-1, 0] > 0.95


def test_a_turn_on_the_spot_is_even():
    made = smoothed_path(turned("y", [0, 5, 50, 60]), 30)
    assert (made.centers - 1).abs().max() < 1e-6
    assert turns(made).sum() > 55
    assert turns(made).max() < 1.1 * turns(made).min()


def test_quaternions_of_either_sign_make_no_detour():
    """A whole turn passes the rotation by 180 degrees, where quaternions change their sign."""
    made = smoothed_path(turned("y", list(range(0, 351, 10))), 60)
    assert 330 < turns(made).sum() < 351
    assert turns(made).max() < 1.1 * turns(made).mean()


@pytest.mark.parametrize("seed", range(5))
def test_views_in_a_jumble_are_brought_in_order(seed):
    cameras = cameras_at(ring(range(0, 150, 10)), np.zeros((15, 3)))
    order = np.random.default_rng(seed).permutation(15).tolist()
    ways = [steps(smoothed_path(c, 60)).sum() for c in (cameras, cameras.select(order))]
    np.testing.assert_allclose(*ways, rtol=1e-3)


def test_a_good_order_is_kept():
    """Neighbors at crossings of the way are nearer than the next view, and are not taken."""
    angles = np.linspace(0, 2 * np.pi, 61)
    eight = np.stack((np.sin(angles), np.sin(2 * angles), np.zeros(61)), 1)
    way = np.append(0, np.linalg.norm(np.diff(eight, axis=0), axis=1).cumsum())
    times = np.linspace(0, way[-1], 60)
    evenly = np.stack([np.interp(times, way, column) for column in eight.T], 1)
    made = smoothed_path(cameras_at(eight), 60)
    assert np.linalg.norm(made.centers.numpy() - evenly, axis=1).max() < 0.15
