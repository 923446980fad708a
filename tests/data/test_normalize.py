from dataclasses import replace

import pytest
import torch

from asysplat import render
from asysplat.data.normalize import normalize
from asysplat.scene import Cameras, Views

HEIGHT, WIDTH = 4, 6


def random_rotations(count: int) -> torch.Tensor:
    """Rotations within about 30 degrees of one another."""
    skew = torch.randn(count, 3, 3) * 0.3
    base = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 2], [1, 0, 0.5], [-2, -0.5, 0]]))
    return torch.linalg.matrix_exp(skew - skew.mT) @ base


def make_views(rotations: torch.Tensor, centers: torch.Tensor) -> Views:
    count = len(rotations)
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = rotations, centers
    intrinsics = torch.tensor([[5.0, 0, 3], [0, 6, 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Views(
        cameras=Cameras(intrinsics, poses, HEIGHT, WIDTH),
        images=torch.rand(count, 3, HEIGHT, WIDTH),
        depths=torch.rand(count, HEIGHT, WIDTH) + 1,
    )


@pytest.fixture
def pair() -> tuple[Views, Views]:
    return (
        make_views(random_rotations(5), torch.randn(5, 3) * 4 + 20),
        make_views(random_rotations(3), torch.randn(3, 3) * 4 + 20),
    )


def relative(views: Views, to: Views) -> torch.Tensor:
    return torch.linalg.inv(to.cameras.cam_to_world[:1]) @ views.cameras.cam_to_world


def test_the_mean_pose_is_the_world_frame_and_the_farthest_input_at_one(pair):
    inputs, _, frame = normalize(*pair)
    centers = inputs.cameras.centers
    torch.testing.assert_close(centers.mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    assert centers.norm(dim=-1).max().item() == pytest.approx(1, abs=1e-5)
    original = pair[0].cameras.centers
    radius = (original - original.mean(0)).norm(dim=-1).max()
    assert frame.scale == pytest.approx(1 / radius.item(), rel=1e-5)
    forward = inputs.cameras.cam_to_world[:, :3, 2].mean(0)
    torch.testing.assert_close(forward[:2], torch.zeros(2), atol=1e-5, rtol=0)
    # The mean down axis lies in the plane of y and z, on y's side.
    down = inputs.cameras.cam_to_world[:, :3, 1].mean(0)
    assert forward[2] > 0 and down[1] > 0 and abs(down[0].item()) < 1e-5


def test_lengths_are_scaled_and_nothing_else_changes(pair):
    inputs, targets, frame = normalize(*pair)
    for before, after in ((pair[0], inputs), (pair[1], targets)):
        expected = relative(before, pair[0])
        expected[:, :3, 3] *= frame.scale
        torch.testing.assert_close(relative(after, inputs), expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(after.depths, before.depths * frame.scale)
        assert torch.equal(after.images, before.images)
        assert torch.equal(after.cameras.intrinsics, before.cameras.intrinsics)


def test_cameras_in_one_place_keep_their_scale_and_a_full_circle_has_a_frame():
    views = make_views(random_rotations(4), torch.tensor([7.0, -3, 2]).expand(4, 3))
    inputs, _, frame = normalize(views, views)
    assert frame.scale == 1
    torch.testing.assert_close(inputs.cameras.centers, torch.zeros(4, 3), atol=1e-6, rtol=0)
    angle = torch.arange(4) * torch.pi / 2
    zero, one = torch.zeros(4), torch.ones(4)
    forward = torch.stack((angle.sin(), zero, angle.cos()), -1)
    right = torch.stack((angle.cos(), zero, -angle.sin()), -1)
    rotations = torch.stack((right, torch.stack((zero, one, zero), -1), forward), -1)
    ring = make_views(rotations, -3 * forward)
    inputs, _, frame = normalize(ring, ring)
    inputs.validate()
    assert normalize(replace(ring, depths=None), ring)[0].depths is None
    assert frame.scale == pytest.approx(1 / 3)
    torch.testing.assert_close(inputs.cameras.cam_to_world[0, :3, :3], torch.eye(3))


@pytest.mark.parametrize("degree", [0, 3])
def test_to_world_keeps_the_renderings(make_scene, degree):
    """The data set's world lies far from the frame of networks, turned and in other units."""
    gaussians, _ = make_scene(count=40, degree=degree)
    _, cameras = make_scene(views=3, height=16, width=16)
    world = make_views(random_rotations(1), torch.randn(1, 3) * 20).cameras.cam_to_world.double()
    poses = cameras.cam_to_world.clone()
    poses[:, :3, 3] *= 7
    given = replace(cameras, cam_to_world=world @ poses)
    views = Views(given, torch.zeros(3, 3, 16, 16, dtype=torch.float64))
    inputs, _, frame = normalize(views, views)
    before = render(gaussians, inputs.cameras, backend="reference", depth=True)
    after = render(frame.to_world(gaussians), given, backend="reference", depth=True)
    assert before.alpha.max() > 0.5 and before.image.std() > 0.05
    torch.testing.assert_close(after.image, before.image, atol=1e-9, rtol=0)
    torch.testing.assert_close(after.alpha, before.alpha, atol=1e-9, rtol=0)
    torch.testing.assert_close(after.depth * frame.scale, before.depth, atol=1e-8, rtol=1e-8)


def test_to_network_inverts_to_world(make_scene, pair):
    gaussians, _ = make_scene(count=40, dtype=torch.float64)
    frame = normalize(*pair)[2]
    back = frame.to_network(frame.to_world(gaussians))
    assert not torch.allclose(frame.to_world(gaussians).means, gaussians.means, atol=1)
    for name in ("means", "scales", "sh"):
        torch.testing.assert_close(getattr(back, name), getattr(gaussians, name))
    # q and -q are one rotation.
    turns = [one.quats[:, :, None] * one.quats[:, None] for one in (back, gaussians)]
    torch.testing.assert_close(*turns)
    world = frame.to_world(gaussians.map(lambda values: values.float())).validate()
    assert world.means.dtype == world.sh.dtype == world.quats.dtype == torch.float32
    assert torch.equal(world.opacities, gaussians.opacities.float())


def test_cameras_come_back_to_the_world(pair):
    inputs, _, frame = normalize(*pair)
    cameras = frame.cameras_to_world(inputs.cameras)
    assert cameras.cam_to_world.dtype == torch.float64
    expected = pair[0].cameras.cam_to_world
    torch.testing.assert_close(cameras.cam_to_world.float(), expected, atol=1e-5, rtol=1e-5)
    assert torch.equal(cameras.intrinsics, pair[0].cameras.intrinsics)
