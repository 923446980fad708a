"""Camera paths: along the cameras' own, and around what they look at."""

import math
from dataclasses import astuple

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from asysplat.data.procedural import ProceduralScene
from asysplat.errors import InputError
from asysplat.export import orbit, smoothed_path
from asysplat.scene import Cameras, Gaussians


def cameras_at(centers, targets=None, roll=0.0) -> Cameras:
    """Cameras in a world with z up, that look along y or at targets."""
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    forward = np.array([0.0, 1, 0]) if targets is None else np.asarray(targets) - centers
    forward = np.broadcast_to(forward, centers.shape)
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = np.stack((right, np.cross(forward, right), forward), 2)
    poses[:, :3, :3] @= Rotation.from_euler("z", roll).as_matrix()
    poses[:, :3, 3] = centers
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    return Cameras(
        intrinsics.repeat(len(centers), 1, 1), torch.tensor(poses, dtype=torch.float32), 48, 64
    )


def ring(angles, radius=2.0, height=0.5):
    angles = np.radians(angles)
    return np.stack(
        (radius * np.cos(angles), radius * np.sin(angles), np.full_like(angles, height)), 1
    )


def turned(axis, angles) -> Cameras:
    """Cameras at one place."""
    cameras = cameras_at(np.ones((len(angles), 3)))
    turns = Rotation.from_euler(axis, np.reshape(angles, (-1, 1)), degrees=True).as_matrix()
    cameras.cam_to_world[:, :3, :3] = torch.tensor(turns, dtype=torch.float32)
    return cameras


HARD = {
    "one": cameras_at([[1, 2, 3]]),
    "two that face each other": cameras_at([[0, -1, 0], [0, 1, 0]], np.zeros((2, 3))),
    "one place, all around": turned("y", list(range(0, 360, 30))),
    "one place, over the top": turned("x", list(range(0, 181, 30))),
    "collinear, forwards": cameras_at([[0, y, 0] for y in range(6)]),
    "ups that cancel": cameras_at(ring([0, 180]), np.zeros((2, 3)), roll=math.pi / 2),
    "pairs at each place": cameras_at(np.repeat(ring(range(0, 90, 15)), 2, 0)),
    "rounding apart": cameras_at(100 + 1e-6 * np.random.default_rng(0).normal(size=(4, 3))),
    "outwards": cameras_at(ring(range(0, 360, 30)), 2 * ring(range(0, 360, 30), height=0.25)),
    "hand-held": ProceduralScene(2, 12, 16).views(list(range(0, 90, 3))).cameras,
}


def panel(x, y, z) -> Gaussians:
    """An opaque box, a Gaussian at every 0.1."""
    axes = [torch.arange(low, high + 0.05, 0.1) for low, high in (x, y, z)]
    means = torch.cartesian_prod(*axes)
    rows = len(means)
    sizes, turns = torch.full((rows, 3), 0.06), torch.eye(4)[:1].repeat(rows, 1)
    return Gaussians(means, turns, sizes, torch.full((rows,), 0.99), torch.zeros(rows, 1, 3))


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(each) for each in zip(*map(astuple, parts), strict=True)))


def evading_orbit(cameras, frames):
    return orbit(cameras, frames, gaussians=panel((0.8, 0.8), (-1, 1), (-1, 1)))


every_path = pytest.mark.parametrize("path", [smoothed_path, orbit, evading_orbit])


@every_path
@pytest.mark.parametrize("case", HARD)
def test_paths_can_be_rendered_whatever_cameras_are_given(path, case):
    for frames in (1, 2, 25):
        made = path(HARD[case], frames).validate()
        assert made.num_views == frames
        assert (made.height, made.width) == (HARD[case].height, HARD[case].width), frames
        assert made.cam_to_world.dtype == torch.float32, frames


@every_path
def test_intrinsics_of_a_path_are_the_mean(path):
    cameras = cameras_at(ring([0, 10, 20]), [[0, 0, 0]] * 3)
    cameras.intrinsics[:, 0, 0] = torch.tensor([40.0, 50, 90])
    made = path(cameras, 4)
    assert torch.equal(made.intrinsics, cameras.intrinsics.mean(0).expand(4, 3, 3))
    assert made.intrinsics[0, 0, 0] == 60


@every_path
def test_paths_refuse_no_frames_and_invalid_cameras(path):
    cameras = cameras_at(ring([0, 10, 20]))
    for given, frames, message in (
        (cameras, 0, "frames is 0"),
        (Cameras.stack([cameras, cameras]), 5, r"shape \(2, 3, 3, 3\): expected \[V, 3, 3\]"),
    ):
        with pytest.raises(InputError, match=message):
            path(given, frames)


def steps(cameras: Cameras) -> np.ndarray:
    return cameras.centers.diff(dim=0).norm(dim=-1).numpy()


def turns(cameras: Cameras) -> np.ndarray:
    """Degrees from each camera to the next."""
    rotations = Rotation.from_matrix(cameras.cam_to_world[:, :3, :3].numpy())
    return np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude())


def test_a_smoothed_walk_is_even_and_where_the_cameras_were():
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


def test_smoothed_paths_pass_through_few_views():
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


def test_smoothed_turns_on_the_spot_are_even():
    made = smoothed_path(turned("y", [0, 5, 50, 60]), 30)
    assert (made.centers - 1).abs().max() < 1e-6
    assert turns(made).sum() > 55
    assert turns(made).max() < 1.1 * turns(made).min()
    # A whole turn passes the rotation by 180 degrees, where quaternions change their sign.
    made = smoothed_path(turned("y", list(range(0, 351, 10))), 60)
    assert 330 < turns(made).sum() < 351
    assert turns(made).max() < 1.1 * turns(made).mean()


def test_smoothed_paths_bring_views_in_a_jumble_in_order():
    cameras = cameras_at(ring(range(0, 150, 10)), np.zeros((15, 3)))
    expected = steps(smoothed_path(cameras, 60)).sum()
    for seed in range(3):
        jumble = cameras.select(np.random.default_rng(seed).permutation(15).tolist())
        way = steps(smoothed_path(jumble, 60)).sum()
        np.testing.assert_allclose(way, expected, rtol=1e-3, err_msg=f"seed {seed}")


def test_smoothed_paths_keep_a_good_order():
    """Neighbors at crossings of the way are nearer than the next view, and are not taken."""
    angles = np.linspace(0, 2 * np.pi, 61)
    eight = np.stack((np.sin(angles), np.sin(2 * angles), np.zeros(61)), 1)
    way = np.append(0, np.linalg.norm(np.diff(eight, axis=0), axis=1).cumsum())
    times = np.linspace(0, way[-1], 60)
    evenly = np.stack([np.interp(times, way, column) for column in eight.T], 1)
    made = smoothed_path(cameras_at(eight), 60)
    assert np.linalg.norm(made.centers.numpy() - evenly, axis=1).max() < 0.15


def test_smoothed_paths_keep_any_order_where_asked():
    angles = [0, 120, 40, 160, 80, 200]
    cameras = cameras_at(ring(angles), np.zeros((6, 3)))
    for as_given, order in ((True, [0, 1, 2, 3, 4, 5]), (False, [0, 2, 4, 1, 3, 5])):
        made = smoothed_path(cameras, 200, as_given=as_given)
        nearest = torch.cdist(cameras.centers, made.centers).argmin(1)
        assert nearest.argsort().tolist() in (order, order[::-1])


def assert_looks_at(cameras: Cameras, point, atol=1e-4):
    ahead = torch.tensor(point) - cameras.centers
    ahead = torch.nn.functional.normalize(ahead, dim=-1)
    torch.testing.assert_close(cameras.cam_to_world[:, :3, 2], ahead.float(), rtol=0, atol=atol)


def test_an_orbit_circles_what_cameras_all_around_look_at():
    made = orbit(cameras_at(ring(range(0, 360, 20)), np.zeros((18, 3))), 36)
    assert_looks_at(made, (0.0, 0, 0))
    torch.testing.assert_close(made.centers[:, :2].norm(dim=-1), torch.full((36,), 2.0))
    torch.testing.assert_close(made.centers[:, 2], torch.full((36,), 0.5))
    # Closed: from the last frame to the first it is as far as between any others.
    around = torch.cat((made.centers, made.centers[:1])).diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(around, torch.full((36,), 4 * math.sin(math.radians(5))))
    assert (made.cam_to_world[:, 2, 1] < 0).all()  # upright: down is down


@pytest.mark.parametrize("start", [0, 300])
def test_an_orbit_stays_on_the_side_of_the_cameras(start):
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


@pytest.mark.parametrize("case", ["outwards", "one place, all around", "one"])
def test_an_orbit_swings_a_little_where_no_point_is_seen_by_most(case):
    made = orbit(HARD[case], 20)
    axes = made.cam_to_world[:, :3, 2]
    assert (axes @ axes.mT).min() > math.cos(math.radians(10.1))
    assert (axes @ axes.mT).min() < math.cos(math.radians(9))
    seen = torch.cat((HARD[case].cam_to_world[:, :3, 2], axes))
    assert (seen[:-20] @ axes.mT).max() > math.cos(math.radians(0.5))


def test_an_orbit_around_a_subject_in_front_of_where_the_axes_meet():
    cameras = cameras_at(ring(range(0, 81, 10)), np.zeros((9, 3)))
    cameras.cam_to_world[4, :3, 3] *= 1.5  # one is far away
    focus = torch.tensor([0.3, 0.3, 0.4])
    made = orbit(cameras, 20, focus)
    assert_looks_at(made, focus.tolist())
    distances = (cameras.centers - focus)[:, :2].norm(dim=-1)
    radius = torch.quantile(distances, 0.9)
    torch.testing.assert_close((made.centers - focus)[:, :2].norm(dim=-1), radius.expand(20))
    assert distances.mean() < radius < distances.max()


# Those in the middle are near the focus, between it and the wall of a room.
IN_ROOM = np.arange(-60, 61, 5)
IN_ROOM = cameras_at(ring(IN_ROOM, np.where(np.abs(IN_ROOM) < 30, 2.0, 4.0)), np.zeros((25, 3)))


def test_an_orbit_stays_in_front_of_a_wall():
    wall = panel((2.6, 2.6), (-1.5, 1.5), (-1, 2))
    before, made = orbit(IN_ROOM, 120), orbit(IN_ROOM, 120, gaussians=wall)

    def beyond(path):
        return (path.centers[:, 0] > 2.5) & (path.centers[:, 1].abs() < 1.5)

    assert beyond(before).sum() > 20 and not beyond(made).any()
    assert_looks_at(made, (0.0, 0, 0))
    torch.testing.assert_close(made.centers[:, 2], before.centers[:, 2])
    # Farther from the wall it is as before, and on its way there it does not jump.
    radii = made.centers[:, :2].norm(dim=-1)
    assert 1.9 < radii.min() < 2.5 and radii.max() > 3.99
    around = torch.cat((made.centers, made.centers[:1])).diff(dim=0).norm(dim=-1)
    assert around.max() < 2 * steps(before).max()


def test_an_orbit_in_an_open_scene_is_the_same_to_the_bit():
    subject = panel((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))
    ground = panel((-5, 5), (-5, 5), (-0.5, -0.5))
    behind = panel((9, 9), (-3, 3), (-1, 2))
    scene = joined(subject, ground, behind)
    for cameras in (IN_ROOM, cameras_at(ring(range(0, 360, 20)), np.zeros((18, 3)))):
        expected = orbit(cameras, 40).cam_to_world
        assert torch.equal(orbit(cameras, 40, gaussians=scene).cam_to_world, expected)
