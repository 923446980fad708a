"""Initial Gaussians: from a prior's depth maps and from sparse points."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.errors import InputError
from asysplat.models.prior import Prior
from asysplat.refinement.init import (
    POINT_OPACITY,
    gaussians_from_points,
    gaussians_from_prior,
    sample_colors,
)
from asysplat.refinement.isotropic import footprints
from asysplat.refinement.merge import SPREAD
from asysplat.rendering.sh import SH_C0
from asysplat.scene import Cameras, Views


def front_views(places=((0.0, 0.0, 0.0),), height=8, width=10, focal=5.0, scale=1.0):
    """Photographs of noise, from cameras that look along z."""
    poses = torch.eye(4).repeat(len(places), 1, 1)
    poses[:, :3, 3] = scale * torch.tensor(places)
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = Cameras(matrix.repeat(len(places), 1, 1), poses, height, width)
    return Views(cameras, torch.rand(len(places), 3, height, width))


def colors(gaussians):
    return gaussians.sh[:, 0] * SH_C0 + 0.5


@pytest.fixture(scope="module")
def room():
    return ProceduralScene(1, 24, 32, 12, places="rooms").views(range(0, 12, 3))


def true_prior(views, opacity=0.5):
    length = views.cameras.pixel_directions().norm(dim=-1)
    distance = (views.depths * length)[None]
    return Prior(distance, torch.ones_like(distance), torch.full_like(distance, opacity))


def test_gaussians_of_a_prior_are_at_the_surface_points(room):
    gaussians = gaussians_from_prior(room, true_prior(room)).validate()
    assert gaussians.num_gaussians == room.depths.numel()
    for view in range(room.num_views):
        part = slice(view * 24 * 32, (view + 1) * 24 * 32)
        pixels, depth, _ = room.cameras.select([view]).project(gaussians.means[part])
        torch.testing.assert_close(depth[0], room.depths[view].flatten(), rtol=1e-4, atol=0)
        y, x = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
        at = torch.stack((x, y), -1).flatten(0, 1)
        assert (pixels[0] - at).abs().max() <= 1e-3
        expected = room.images[view].flatten(1).mT
        torch.testing.assert_close(colors(gaussians)[part], expected, rtol=0, atol=1e-6)
    assert (gaussians.opacities == 0.5).all()
    assert (gaussians.quats == torch.tensor([1.0, 0, 0, 0])).all()


@pytest.mark.parametrize("size", [(4, 5), (3, 7), (8, 10), (20, 11), (1, 1)], ids=str)
def test_a_prior_of_any_size(size):
    """Of fewer pixels than the photographs, of more, and of such as do not divide them."""
    views = front_views(height=8, width=10)
    distance = torch.full((1, 1, *size), 2.0)
    gaussians = gaussians_from_prior(views, Prior(distance, distance, distance / 4)).validate()
    assert gaussians.num_gaussians == size[0] * size[1]
    if size == (8, 10):  # a focal length of 5: at a distance of 2, a pixel is 2 / 5 wide
        torch.testing.assert_close(gaussians.scales, torch.full((80, 3), SPREAD * 2 / 5))
        torch.testing.assert_close(gaussians.means.norm(dim=-1), torch.full((80,), 2.0))
    if size == (4, 5):
        blocks = views.images[0].unflatten(1, (4, 2)).unflatten(3, (5, 2)).mean((2, 4))
        torch.testing.assert_close(colors(gaussians), blocks.flatten(1).mT, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        colors(gaussians).mean(0), views.images.mean((0, 2, 3)), rtol=0, atol=0.15
    )


def test_masked_pixels_get_no_gaussian():
    views = front_views(height=8, width=10)
    masks = torch.ones(1, 8, 10, dtype=torch.bool)
    masks[0, 0, 0] = False  # a quarter of the first block
    masks[0, 4:, 2:] = False  # eight blocks, wholly
    distance = torch.full((1, 1, 4, 5), 2.0)
    prior = Prior(distance, distance, distance / 4)
    every = gaussians_from_prior(views, prior)
    some = gaussians_from_prior(replace(views, masks=masks), prior)
    expected = every.keep(
        torch.tensor([i not in (0, 11, 12, 13, 14, 16, 17, 18, 19) for i in range(20)])
    )
    assert torch.equal(some.means, expected.means) and torch.equal(some.sh, expected.sh)
    none = gaussians_from_prior(replace(views, masks=torch.zeros_like(masks)), prior)
    assert torch.equal(none.means, every.means)


def test_footprints_are_the_smallest_over_visible_views():
    views = front_views(places=[(0.0, 0, 0), (0.0, 0, 1), (9.0, 0, 0)])
    cameras = replace(views.cameras, intrinsics=views.cameras.intrinsics.clone())
    cameras.intrinsics[2, :2, :2] *= 100  # the third is fine, and sees nothing of this
    # At depths 2 and 1, a focal length of 5; outside of the second: 0.9 / 0.5 * 5 + 5 = 14 of 10
    # pixels; behind all: 5 from the first, 500 the third's focal length.
    points = torch.tensor([[0.0, 0, 2], [0.9, 0, 1.5], [0.0, 3, -4]])
    behind = (9.0**2 + 3**2 + 4**2) ** 0.5 / 500
    expected = torch.tensor([1 / 5, 1.5 / 5, behind])
    torch.testing.assert_close(footprints(points, cameras), expected)
    found = footprints(torch.zeros(2, 3), front_views().cameras)
    assert (found > 0).all() and (found < 1e-30).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_invariance_to_the_scene_unit(scale):
    places = [(0.0, 0, 0), (0.5, 0.1, 0)]
    torch.manual_seed(3)
    views, plain = front_views(places, scale=scale), front_views(places)
    points = torch.rand(50, 3) * torch.tensor([2.0, 2, 3]) + torch.tensor([-1.0, -1, 1])
    expected = gaussians_from_points(points, plain)
    found = gaussians_from_points(points * scale, replace(views, images=plain.images))
    torch.testing.assert_close(found.means / scale, expected.means)
    torch.testing.assert_close(found.scales / scale, expected.scales)
    torch.testing.assert_close(found.sh, expected.sh)
    sizes = footprints(points * scale, views.cameras) / scale
    torch.testing.assert_close(sizes, footprints(points, plain.cameras))


def test_points_have_the_mean_distance_of_neighbors_as_size():
    points = torch.tensor([[0.0, 0, 5], [3.0, 0, 5], [0.0, 4, 5], [0.0, 0, 6], [100.0, 0, 5]])
    gaussians = gaussians_from_points(points, front_views(focal=50.0)).validate()
    torch.testing.assert_close(gaussians.scales[0], torch.full((3,), (3 + 4 + 1) / 3))
    assert (gaussians.opacities == POINT_OPACITY).all()
    for few, size in ((1, 2 / 5), (2, 0.5), (3, 0.5)):  # a pixel, and the mean of the others
        points = torch.tensor([[0.0, 0, 2], [0.0, 0, 2.5], [0.5, 0, 2]])[:few]
        gaussians = gaussians_from_points(points, front_views()).validate()
        torch.testing.assert_close(gaussians.scales[0], torch.full((3,), size))
    for place in ([0.0, 0.0, 2.0], [0.0, 0.0, 0.0]):  # coincident: before a camera, and at it
        points = torch.tensor(place).repeat(6, 1)
        gaussians = gaussians_from_points(points, front_views()).validate()
        expected = footprints(points, front_views().cameras)
        assert torch.equal(gaussians.scales, expected[:, None].repeat(1, 3))


def test_invalid_points_are_refused():
    bad = torch.tensor([[0.0, 0, 1], [torch.nan, torch.inf, 1]])
    for points, found in ((bad[:0], "got 0 points"), (bad, "2 points with 2 coordinates")):
        with pytest.raises(InputError, match=f"{found}.*give at least one point, and finite"):
            gaussians_from_points(points, front_views())


def test_colors_are_the_mean_of_unmasked_pixels():
    views = front_views(places=[(0.0, 0, 0), (1.0, 0, 0)])
    points = torch.tensor([[0.5, 0.1, 2.0], [-1.9, -1.5, 2.0], [0.0, 0, -1]])
    # In the first view (6.25, 4.25) and (0.25, 0.25); in the second (3.75, 4.25) and outside.
    one, two = views.images[0, :, 4, 6], views.images[1, :, 4, 3]
    corner, gray = views.images[0, :, 0, 0], torch.full((3,), 0.5)
    expected = torch.stack(((one + two) / 2, corner, gray))
    torch.testing.assert_close(sample_colors(points, views), expected)
    masks = torch.ones(2, 8, 10, dtype=torch.bool)
    masks[1, 4, 3] = masks[0, 0, 0] = False
    found = sample_colors(points, replace(views, masks=masks))
    torch.testing.assert_close(found, torch.stack((one, gray, gray)))


def test_cameras_at_one_position(room):
    poses = room.cameras.cam_to_world.clone()
    poses[:, :3, 3] = poses[0, :3, 3]
    views = replace(room, cameras=replace(room.cameras, cam_to_world=poses))
    gaussians = gaussians_from_prior(views, true_prior(views)).validate()
    assert footprints(gaussians.means, views.cameras).isfinite().all()
    gaussians_from_points(gaussians.means[::50], views).validate()
