"""MVSplat: its volume, its windows, its Gaussians, the numbers of views that it takes."""

import math
from itertools import product

import pytest
import torch
from scipy.spatial.transform import Rotation
from test_asysplat import make_views

from asysplat.errors import InputError
from asysplat.models.mvsplat import (
    MAX_SH_DEGREE,
    WINDOWS,
    cost_volume,
    multiply,
    quaternions,
    same_region,
    windows,
)
from asysplat.rendering import render
from asysplat.scene import Cameras


@pytest.fixture
def net(build):
    torch.manual_seed(0)
    return build("model=mvsplat", "width=0.0625", "model.planes=8")


def test_parameters_are_the_published_ones(build):
    """The paper's Table 5: 12M."""
    net = build("model=mvsplat", "scale=paper", device="meta")
    assert abs(sum(p.numel() for p in net.parameters()) / 12e6 - 1) < 0.03


def test_a_gaussian_for_each_pixel_and_gradients_for_each_parameter(net):
    views = make_views(batch=(2,), views=3, height=32, width=48)
    gaussians = net.train()(views)
    assert gaussians.validate().num_gaussians == 3 * 32 * 48
    assert gaussians.sh.shape[-2] == (MAX_SH_DEGREE + 1) ** 2
    # Each is within its pixel.
    own = Cameras(views.cameras.intrinsics[0, :1], views.cameras.cam_to_world[0, :1], 32, 48)
    pixels, depth, _ = own.project(gaussians.means[0, : 32 * 48])
    places = torch.tensor(list(product(range(32), range(48)))).flip(-1)
    assert ((pixels[0] - places).abs() <= 1.001).all() and ((pixels[0] - places) >= -1e-3).all()
    assert depth.min() >= 0.499 and depth.max() <= 100.1
    render(gaussians, views.cameras, torch.zeros(3)).image.square().mean().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_every_view_reaches_every_other(net):
    views = make_views(batch=(1,), views=3)
    before = net.eval()(views).opacities.unflatten(1, (3, -1))
    views.images[:, 2] = torch.rand(3, 32, 64)
    after = net(views).opacities.unflatten(1, (3, -1))
    assert ((after - before).abs().amax((0, 2)) > 0).all()


def test_the_order_of_the_views_does_not_matter(net):
    views = make_views(batch=(1,), views=3)
    order = [2, 0, 1]
    one = net.eval()(views).means.unflatten(1, (3, -1))[:, order]
    other = net(views.select(order)).means.unflatten(1, (3, -1))
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_the_volume_is_highest_at_the_depth_of_a_surface():
    """A wall at depth 2 whose features are sines of the place on it."""
    inverse = torch.linspace(0.1, 1.0, 10)
    views = make_views(batch=(1,), views=3, height=16, width=64)
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    poses[0, :, 0, 3] = torch.tensor([-0.4, 0.0, 0.3])
    cameras = Cameras(views.cameras.intrinsics, poses, 16, 64)
    points = cameras.centers[:, :, None, None] + 2.0 * cameras.pixel_directions()
    angles = points[..., :1] * torch.tensor([3.0, 7.0, 13.0, 23.0])
    features = torch.cat((angles.sin(), angles.cos()), dim=-1).movedim(-1, 2)
    volume = cost_volume(features, cameras, inverse)
    best = inverse[volume.argmax(2)]
    inner = best[..., 20:-20]
    assert (inner - 0.5).abs().max() < 0.06
    turned = poses[:, :2].clone()
    turned[:, 1, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    facing_away = Cameras(views.cameras.intrinsics[:, :2], turned, 16, 64)
    assert not cost_volume(features[:, :2], facing_away, inverse).any()


@pytest.mark.parametrize("size", [(4, 8), (8, 8)])
def test_shifted_windows_see_only_neighbors(size):
    """No window joins pixels from opposite borders of the map."""
    shift = [side // WINDOWS // 2 for side in size]
    visible = same_region(size, shift, torch.device("cpu"))
    places = torch.stack(torch.meshgrid(*map(torch.arange, size), indexing="ij"), dim=-1)
    moved = torch.roll(places, [-s for s in shift], (0, 1))
    moved = windows(moved[None, None])[0, 0]
    apart = (moved[:, :, None] - moved[:, None]).abs()
    near = (apart < torch.tensor(size) // WINDOWS).all(-1)
    assert torch.equal(visible, near)
    unshifted = same_region(size, [0, 0], torch.device("cpu"))
    assert unshifted.all() and not visible.all()


def test_quaternions_are_those_of_scipy():
    one, other = Rotation.random(500, random_state=0), Rotation.random(500, random_state=1)
    half_turns = Rotation.from_rotvec(math.pi * torch.eye(3).numpy())

    def quats(rotation):
        return torch.from_numpy(rotation.as_quat(scalar_first=True))

    for rotation in (one, half_turns):
        found = quaternions(torch.from_numpy(rotation.as_matrix()))
        assert found.norm(dim=-1).min() >= 1 - 1e-9
        cosines = (torch.nn.functional.normalize(found, dim=-1) * quats(rotation)).sum(-1)
        torch.testing.assert_close(cosines.abs(), torch.ones_like(cosines))
    product = (multiply(quats(one), quats(other)) * quats(one * other)).sum(-1)
    torch.testing.assert_close(product.abs(), torch.ones_like(product))


@pytest.mark.parametrize(("views", "fit"), [(1, 2), (9, 8)])
def test_a_number_of_views_that_it_does_not_take(net, views, fit):
    message = f"2 to 8 input views and got {views}: set data.inputs={fit}"
    with pytest.raises(InputError, match=message):
        net(make_views(batch=(1,), views=views))
