"""Both heads: untrained Gaussians, ranges, extreme numbers."""

import math

import pytest
import torch

from asysplat.models import LongLRMHead, ResidualHead
from asysplat.rendering import render
from asysplat.scene import Cameras, Views

HEADS = {"residual": ResidualHead, "longlrm": LongLRMHead}
SIZE, FOCAL = 16, 20.0


def make_views():
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, :3, 3] = torch.tensor([1.0, 0.5, -0.2])
    intrinsics = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics.repeat(1, 2, 1, 1), pose, SIZE, SIZE)
    return Views(cameras, torch.rand(1, 2, 3, SIZE, SIZE))


def decode(kind, fill, views=None, stride=2):
    """Gaussians of a head whose 59 decoded numbers are `fill` [59], and the numbers."""
    head = HEADS[kind](8, 8 * stride, 8)
    place = SIZE // (8 * stride)
    raw = torch.as_tensor(fill, dtype=torch.float32).expand(64, 59).flatten().clone()
    raw.requires_grad_()
    head.decode.register_forward_hook(lambda *_: raw.expand(1, 2, place, place, -1))
    return head(torch.zeros(1, 2, place, place, 8), views or make_views()), raw


def distances(gaussians, views):
    """Distances of the means from their view's camera, [V, n]."""
    centers = views.cameras.centers.reshape(-1, 1, 3)
    return (gaussians.means.reshape(len(centers), -1, 3) - centers).norm(dim=-1)


def test_an_untrained_residual_head_starts_in_the_middle_of_the_depths():
    views = make_views()
    gaussians, _ = decode("residual", torch.zeros(59), views)
    middle = math.sqrt(0.1 * 100)
    torch.testing.assert_close(distances(gaussians, views), torch.full((2, 64), middle))
    # Half the resolution has half the focal length in pixels.
    size = math.exp(-0.5) * middle / (FOCAL / 2)
    torch.testing.assert_close(gaussians.scales, torch.full_like(gaussians.scales, size))
    assert (gaussians.opacities == 0.5).all()
    assert (gaussians.quats == torch.tensor([1.0, 0, 0, 0])).all()
    colors = gaussians.sh[0, :, 0].reshape(2, 8, 8, 3) * 0.28209479 + 0.5
    images = torch.nn.functional.avg_pool2d(views.images[0], 2).permute(0, 2, 3, 1)
    torch.testing.assert_close(colors, images)
    assert (gaussians.sh[0, :, 1:] == 0).all()


def test_longlrm_by_hand():
    """Position 3, quaternion 4, scale 3, opacity 1, colors: all as decoded, whatever the image."""
    views = make_views()
    numbers = torch.arange(59.0) / 10 - 2
    gaussians, _ = decode("longlrm", numbers, views)
    distance = 500 * torch.sigmoid(numbers[:3].mean())
    torch.testing.assert_close(distances(gaussians, views), distance.expand(2, 64))
    assert (gaussians.quats == numbers[3:7]).all()
    torch.testing.assert_close(gaussians.scales[0, 0], (numbers[7:10] - 6.9).exp())
    torch.testing.assert_close(gaussians.opacities[0, 0], (numbers[10] - 2).sigmoid())
    torch.testing.assert_close(gaussians.sh[0, 0], numbers[11:].reshape(16, 3))


def test_longlrm_lengths_are_in_units_of_the_largest_coordinate_of_an_input_camera():
    """In Long-LRM's normalization it is 1; in ours a camera is at distance 1 in any direction."""
    views, numbers = make_views(), torch.arange(59.0) / 10 - 2
    unit, _ = decode("longlrm", numbers, views)
    views.cameras.cam_to_world[0, 1, :3, 3] = torch.tensor([0.48, -0.6, 0.64])
    smaller, _ = decode("longlrm", numbers, views)
    torch.testing.assert_close(smaller.scales, 0.64 * unit.scales)
    torch.testing.assert_close(distances(smaller, views), 0.64 * distances(unit, make_views()))
    views.cameras.cam_to_world[..., :3, 3] = 0  # no scale at all: finite
    assert decode("longlrm", numbers, views)[0].means.abs().sum() > 0


RANGES = {  # of distances, and of sizes at the farthest
    "residual": (0.1, 100.0, math.exp(3) * 100 / (FOCAL / 2)),
    "longlrm": (0.0, 500.0, math.exp(-1.2)),
}


@pytest.mark.parametrize("raw", [-1e4, 1e4])
@pytest.mark.parametrize("kind", HEADS)
def test_extreme_numbers_stay_in_range_and_render_with_finite_gradients(kind, raw):
    views = make_views()
    gaussians, leaf = decode(kind, torch.full((59,), raw), views)
    near, far, largest = RANGES[kind]
    expected = torch.full((2, 64), far if raw > 0 else near)
    torch.testing.assert_close(distances(gaussians, views), expected)
    assert (gaussians.scales > 0).all()
    assert gaussians.scales.max() <= largest * (1 + 1e-5)
    if raw > 0:
        torch.testing.assert_close(gaussians.scales.max().item(), largest)
    rendering = render(gaussians, views.cameras, torch.full((3,), 0.5), depth=True)
    (rendering.image.square().mean() + rendering.depth.mean()).backward()
    assert rendering.image.isfinite().all() and leaf.grad.isfinite().all()


@pytest.mark.parametrize("kind", HEADS)
def test_gradients_of_every_decoded_number(kind):
    torch.manual_seed(0)
    gaussians, leaf = decode(kind, 0.1 * torch.randn(59))
    sum((field.square()).sum() for field in vars(gaussians).values()).backward()
    assert leaf.grad.isfinite().all() and (leaf.grad != 0).all()


def test_a_distance_of_500_is_rendered():
    """A Gaussian at the far end of Long-LRM's range, large enough to cover pixels."""
    views = make_views()
    numbers = torch.zeros(59)
    numbers[:3], numbers[7:11], numbers[11] = 50.0, 50.0, 1.0  # far, largest, opaque, red
    numbers[3] = 1.0
    gaussians, _ = decode("longlrm", numbers, views)
    rendering = render(gaussians, views.cameras, torch.zeros(3), depth=True)
    assert (rendering.alpha.amax((-1, -2)) > 0.5).all()
    depths = rendering.depth[rendering.alpha > 0.5]
    assert ((depths > 400) & (depths < 501)).all()
