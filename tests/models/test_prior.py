"""Priors: their maps, unknown depths, and the model that is a plane sweep alone."""

from dataclasses import replace

import pytest
import torch

from asysplat import load
from asysplat.models import PlaneSweep
from asysplat.models.prior.prior import FREE_OPACITY, SURFACE_OPACITY, UNKNOWN_DISTANCE, Prior
from asysplat.scene import Cameras, Views

GRID = (16, 16)


def swept(views, **options):
    return Prior.from_estimate(PlaneSweep(**options).sweep(views), views, GRID)


def known(views):
    return Prior.from_depth_maps(views.depths, views, GRID)


PRIORS = {"plane_sweep": swept, "depth": known}


def wall(views=4, size=32, depth=2.0, step=0.15):
    """Views of a textured wall from cameras side by side, with depths."""
    poses = torch.eye(4).repeat(1, views, 1, 1)
    poses[0, :, 0, 3] = step * torch.arange(views)
    intrinsics = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    cameras = Cameras(intrinsics.repeat(1, views, 1, 1), poses, size, size)
    directions = cameras.pixel_directions()
    places = poses[..., None, None, :3, 3] + depth * directions
    waves = torch.tensor([[7.0, 3.0], [-2.0, 9.0], [5.0, -6.0]])
    images = 0.5 + 0.4 * torch.sin(places[..., :2] @ waves.T).permute(0, 1, 4, 2, 3)
    return Views(cameras, images, torch.full(images.shape[:2] + images.shape[-2:], depth))


@pytest.mark.parametrize("name", PRIORS)
def test_a_wall_is_where_it_is(name):
    views = wall()
    prior = PRIORS[name](views)
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)
    inner = (slice(None), slice(None), slice(2, -2), slice(4, -4))
    torch.testing.assert_close(prior.distance[inner], 2 * length[inner], rtol=0.05, atol=0)


@pytest.mark.parametrize("option", [{"planes": 8}, {"neighbors": 1}, {"longest_side": 8}])
def test_a_coarser_plane_sweep_is_less_exact(option):
    views = wall()
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)

    def error(**options):
        found = swept(views, **options).distance / length
        return (found[:, :, 2:-2, 4:-4] - 2).abs().mean()

    assert 0 < error() < error(**option) < 1


@pytest.mark.parametrize("name", PRIORS)
def test_a_masked_pixel_neither_votes_nor_is_kept(name):
    views = wall(4)
    masks = torch.ones_like(views.depths, dtype=torch.bool)
    masks[:, 1, :16] = False  # the upper half of the second view,
    masks[:, 0, 31, 31] = False  # and a quarter of the first's last pixel
    whole, prior = (PRIORS[name](each) for each in (views, replace(views, masks=masks)))
    valid = torch.ones(1, 4, 16, 16, dtype=torch.bool)
    valid[:, 1, :8] = valid[:, 0, 15, 15] = False
    assert (prior.opacity == FREE_OPACITY).eq(~valid).all()
    # The views that remain have a larger part of the wall's opacity.
    others = (slice(None), [0, 2, 3], slice(1, 6), slice(5, 11))
    assert prior.opacity[others].mean() > 1.1 * whole.opacity[others].mean()


@pytest.mark.parametrize("name", PRIORS)
def test_depths_of_one_view_are_unknown(name):
    views = wall(1)
    prior = PRIORS[name](replace(views, depths=torch.zeros_like(views.depths)))
    assert (prior.distance == UNKNOWN_DISTANCE).all()


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("views", [2, 4, 8])
def test_views_share_the_opacity_of_a_wall(name, views):
    prior = PRIORS[name](wall(views, step=0.1))
    middle = prior.opacity[:, views // 2, 4:12, 4:12]
    hidden = 1 - (1 - middle) ** views
    assert hidden.median() > 0.8 and hidden.max() < 0.98


def test_a_surface_in_one_view_alone_is_opaque():
    views = wall(2, step=1.5)  # three quarters of an image at the wall's distance
    prior = known(views)
    assert (prior.opacity[:, 0, :, :11] - SURFACE_OPACITY).abs().max() < 1e-3
    assert prior.opacity[:, 0, :, 13:].max() < 0.8


def test_the_model_gives_a_gaussian_for_each_pixel_of_any_batch():
    views, net = wall(), load("shipped")
    gaussians = net(views)
    assert gaussians.num_gaussians == 4 * 32 * 32 and next(net.parameters(), None) is None
    _, depth, inside = views.cameras.map(lambda x: x[0]).project(gaussians.means[0])
    assert depth[inside].median().item() == pytest.approx(2, rel=0.02)
    alone, both = net(views.map(lambda x: x[0])), net(Views.stack([views, views]))
    for name, field in vars(gaussians).items():
        assert torch.equal(getattr(alone, name), field[0])
        assert torch.equal(getattr(both, name)[1], field)


def test_colors_and_places_have_gradients():
    views = wall(2)
    poses = views.cameras.cam_to_world.clone().requires_grad_()
    images = views.images.clone().requires_grad_()
    views = Views(replace(views.cameras, cam_to_world=poses), images)
    gaussians = load("shipped")(views)
    of_poses, of_images = torch.autograd.grad(
        gaussians.means.sum() + gaussians.sh.sum(), (poses, images)
    )
    assert (of_poses[..., :3, 3] == 32 * 32).all() and (of_images != 0).all()


def test_depth_maps_are_averaged_over_known_pixels():
    views = wall(1)
    depths = views.depths.clone()
    depths[..., :20] = 0
    depths[..., 0, 17] = 4.0
    prior = known(replace(views, depths=depths))
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)
    assert (prior.distance[..., 10:] / length[..., 10:]).mean().item() == pytest.approx(2, rel=1e-3)
    assert prior.distance.min() > 1.5  # gaps are filled from their surroundings
