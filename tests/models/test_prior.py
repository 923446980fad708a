"""Priors: their maps, unknown depths, their effect on heads, and all models with one."""

import math
from dataclasses import replace

import pytest
import torch
from test_head import make_views
from tiny import SIZE

from asysplat.models import DepthPrior, LongLRMHead, PlaneSweepPrior, ResidualHead
from asysplat.models.head import CONFIDENT_FACTOR, MAX_DEPTH_CORRECTION
from asysplat.models.prior.prior import FREE_OPACITY, SURFACE_OPACITY, UNKNOWN_DISTANCE, Prior
from asysplat.scene import Cameras, Views

MODELS = ["asysplat_4m4s", "longlrm", "single_branch", "asysplat_pred_fine"]
PRIORS = {"plane_sweep": PlaneSweepPrior, "depth": DepthPrior}


def wall(views=4, size=32, depth=2.0, step=0.15, depths=True):
    """Views of a textured wall from cameras side by side, with depths if any."""
    poses = torch.eye(4).repeat(1, views, 1, 1)
    poses[0, :, 0, 3] = step * torch.arange(views)
    intrinsics = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    cameras = Cameras(intrinsics.repeat(1, views, 1, 1), poses, size, size)
    directions = cameras.pixel_directions()
    places = poses[..., None, None, :3, 3] + depth * directions
    waves = torch.tensor([[7.0, 3.0], [-2.0, 9.0], [5.0, -6.0]])
    images = 0.5 + 0.4 * torch.sin(places[..., :2] @ waves.T).permute(0, 1, 4, 2, 3)
    known = torch.full(images.shape[:2] + images.shape[-2:], depth)
    return Views(cameras, images, known if depths else None)


@pytest.mark.parametrize("name", PRIORS)
def test_a_wall_is_where_it_is(name):
    views = wall()
    prior = PRIORS[name]()(views, (16, 16))
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)
    inner = (slice(None), slice(None), slice(2, -2), slice(4, -4))
    torch.testing.assert_close(prior.distance[inner], 2 * length[inner], rtol=0.05, atol=0)
    assert prior.confidence[inner].mean() > 0.8


@pytest.mark.parametrize("option", [{"planes": 8}, {"neighbors": 1}, {"longest_side": 8}])
def test_a_coarser_plane_sweep_is_less_exact(option):
    views = wall()
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)

    def error(**options):
        found = PlaneSweepPrior(**options)(views, (16, 16)).distance / length
        return (found[:, :, 2:-2, 4:-4] - 2).abs().mean()

    assert 0 < error() < error(**option) < 1


@pytest.mark.parametrize("name", PRIORS)
def test_a_masked_pixel_neither_votes_nor_is_kept(name):
    views = wall(4)
    masks = torch.ones_like(views.depths, dtype=torch.bool)
    masks[:, 1, :16] = False  # the upper half of the second view,
    masks[:, 0, 31, 31] = False  # and a quarter of the first's last pixel
    whole, prior = (PRIORS[name]()(each, (16, 16)) for each in (views, replace(views, masks=masks)))
    valid = torch.ones(1, 4, 16, 16, dtype=torch.bool)
    valid[:, 1, :8] = valid[:, 0, 15, 15] = False
    assert (prior.opacity == FREE_OPACITY).eq(~valid).all()
    assert not prior.confidence[:, 1, :6].any()
    # The views that remain have a larger part of the wall's opacity.
    others = (slice(None), [0, 2, 3], slice(1, 6), slice(5, 11))
    assert prior.opacity[others].mean() > 1.1 * whole.opacity[others].mean()


@pytest.mark.parametrize("name", PRIORS)
def test_depths_of_one_view_are_unknown(name):
    prior = PRIORS[name]()(wall(1, depths=False), (16, 16))
    assert prior.distance.isfinite().all() and (prior.distance > 0).all()
    assert prior.confidence.max() == 0


def test_unknown_is_the_untrained_distance():
    views = make_views()
    head = ResidualHead(8, 16, 8)
    torch.nn.init.zeros_(head.decode.weight)
    shape = (1, 2, 8, 8)
    unknown = Prior(torch.full(shape, UNKNOWN_DISTANCE), torch.zeros(shape), torch.full(shape, 0.5))
    tokens = torch.zeros(1, 2, 1, 1, 8)
    with_prior, without = head(tokens, views, unknown), head(tokens, views)
    torch.testing.assert_close(with_prior.means, without.means)
    torch.testing.assert_close(with_prior.opacities, without.opacities)


@pytest.mark.parametrize("head", [ResidualHead, LongLRMHead])
def test_gaussians_start_at_the_priors_distance(head):
    views = make_views()
    built = head(8, 16, 8)
    torch.nn.init.zeros_(built.decode.weight)
    distance = torch.linspace(0.5, 8, 128).reshape(1, 2, 8, 8)
    confidence = torch.linspace(0, 1, 128).reshape(1, 2, 8, 8)
    prior = Prior(distance, confidence, 0.1 + 0.8 * confidence)
    gaussians = built(torch.zeros(1, 2, 1, 1, 8), views, prior)
    origins = views.cameras.centers[0, :, None].expand(2, 64, 3).reshape(-1, 3)
    found = (gaussians.means[0] - origins).norm(dim=-1)
    torch.testing.assert_close(found, distance.flatten(), rtol=1e-4, atol=0)
    torch.testing.assert_close(gaussians.opacities[0], prior.opacity.flatten())


@pytest.mark.parametrize("confident", [0.0, 1.0])
def test_corrections_are_bounded_if_a_depth_is_known(confident):
    views, shape = make_views(), (1, 2, 8, 8)
    head = ResidualHead(8, 16, 8)
    torch.nn.init.normal_(head.decode.weight, std=100.0)
    confidence = torch.full(shape, confident)
    confidence[0, 0, 0, 0] = 0.5
    prior = Prior(torch.full(shape, 3.0), confidence, torch.full(shape, 0.5))
    tokens = torch.randn(1, 2, 1, 1, 8)
    start = ResidualHead(8, 16, 8)
    torch.nn.init.zeros_(start.decode.weight)
    corrected, before = head(tokens, views, prior), start(tokens, views, prior)
    origins = views.cameras.centers[0, :, None].expand(2, 64, 3).reshape(-1, 3)
    ratio = (corrected.means[0] - origins).norm(dim=-1) / (before.means[0] - origins).norm(dim=-1)
    # A logit is at most a quarter of the range, which is a factor of 1000.
    bound = MAX_DEPTH_CORRECTION * (CONFIDENT_FACTOR if confident else 1) / 4 * math.log(1000)
    assert ratio[1:].log().abs().max() <= 1.001 * bound
    assert (corrected.opacities.logit() - before.opacities.logit()).abs().max() <= 0.501
    # Sizes are in pixels, so that they follow the distance.
    assert (corrected.scales / before.scales).log().abs().max() <= 1.001 * (
        1 + 0.3 / 4 * math.log(1000)
    )
    unknown = replace(prior, confidence=torch.zeros(shape))
    free = head(tokens, views, unknown)
    assert ((free.means[0] - origins).norm(dim=-1) / 3).log().abs().max() > 1


def test_features_are_bounded_at_any_distance():
    distance = torch.tensor([1e-6, 1.0, 1e6]).reshape(1, 1, 1, 3)
    half = torch.full_like(distance, 0.5)
    features = Prior(distance, half, half).features(1, 3)
    assert features.shape == (1, 1, 1, 3, 2) and features.abs().max() <= 2
    assert (features[..., 0].diff(dim=-1) > 0).all()


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("views", [2, 4, 8])
def test_views_share_the_opacity_of_a_wall(name, views):
    prior = PRIORS[name]()(wall(views, step=0.1), (16, 16))
    middle = prior.opacity[:, views // 2, 4:12, 4:12]
    hidden = 1 - (1 - middle) ** views
    assert hidden.median() > 0.8 and hidden.max() < 0.98


def test_a_surface_in_one_view_alone_is_opaque():
    views = wall(2, step=1.5)  # three quarters of an image at the wall's distance
    prior = DepthPrior()(views, (16, 16))
    assert (prior.opacity[:, 0, :, :11] - SURFACE_OPACITY).abs().max() < 1e-3
    assert prior.opacity[:, 0, :, 13:].max() < 0.8


@pytest.mark.medium
@pytest.mark.parametrize("model", MODELS)
def test_every_model_takes_a_prior(build, model):
    views = wall(2)
    plain, swept = (
        build(*SIZE, f"model={model}", f"model/prior={prior}") for prior in ("none", "plane_sweep")
    )
    gaussians = swept(views)
    assert gaussians.num_gaussians == plain(views).num_gaussians
    sum(field.sum() for field in vars(gaussians).values()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in swept.parameters())
    tokenizers = {n for n, _ in plain.named_parameters() if "tokenizer.embed" in n}
    different = {
        name
        for (name, a), b in zip(plain.named_parameters(), swept.parameters(), strict=True)
        if a.shape != b.shape
    }
    assert different == tokenizers


def test_depth_maps_are_averaged_over_known_pixels():
    views = wall(1)
    depths = views.depths.clone()
    depths[..., :20] = 0
    depths[..., 0, 17] = 4.0
    prior = DepthPrior()(replace(views, depths=depths), (16, 16))
    assert prior.confidence[0, 0, 0, 8] == 0.25 and prior.confidence[..., :8].max() == 0
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)
    assert (prior.distance[..., 10:] / length[..., 10:]).mean().item() == pytest.approx(2, rel=1e-3)
    assert prior.distance.min() > 1.5  # gaps are filled from their surroundings
