"""Early exit: exact when off, skips what its thresholds name, and reports the fractions."""

import math
from dataclasses import replace

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from test_prior import wall
from tiny import NETWORK

from asysplat.errors import InputError, input_error_behind
from asysplat.models import EarlyExit
from asysplat.models.network import EXACT
from asysplat.rendering import render
from asysplat.scene import Views

ALWAYS = 1e-6  # a confidence that every scene with a known depth exceeds
NEVER = 1.0  # a confidence that no scene reaches


@pytest.fixture
def net(build):
    """A network of three stages with two layers each, whose head corrects the prior visibly."""
    net = build("model=asysplat_plane_sweep", *NETWORK).eval()
    torch.nn.init.normal_(net.head.decode.weight, std=0.05)
    return net


def layers_of(stage):
    return getattr(stage, "layers", stage)


@torch.no_grad()
def predict(net, views, **thresholds):
    net.early_exit = EarlyExit(**thresholds)
    return net(views)


def same_bits(one, other):
    return all(map(torch.equal, vars(one).values(), vars(other).values()))


@pytest.mark.medium
def test_off_is_exact_and_reports_nothing(net, composed):
    exact = predict(net, wall())
    assert instantiate(composed("speed=exact").speed) == EXACT == net.early_exit
    assert net.early_exit_fractions == {}
    assert same_bits(exact, net.predict(wall()))


@pytest.mark.parametrize("threshold", ["skip_layers_above", "skip_network_above"])
def test_a_threshold_that_no_scene_reaches_changes_no_bit(net, threshold):
    exact = predict(net, wall())
    assert same_bits(exact, predict(net, wall(), **{threshold: NEVER}))
    assert set(net.early_exit_fractions.values()) == {0.0}


@torch.no_grad()
def test_training_skips_nothing(net):
    results = []
    for net.early_exit in (EXACT, EarlyExit(skip_network_above=ALWAYS)):
        torch.manual_seed(0)
        results.append(net.train()(wall()))
        assert net.early_exit_fractions == {}
    assert same_bits(*results)


def test_skipped_layers_are_those_after_the_first_stage(net):
    called = []
    branches = net.geometry.stages, net.appearance.stages
    for layer in [
        layer for stages in branches for stage in stages[1:] for layer in layers_of(stage)
    ]:
        layer.register_forward_hook(lambda module, *_: called.append(module))
    exact = predict(net, wall())
    assert set(called) == set(net.skippable_layers)
    called.clear()
    found = predict(net, wall(), skip_layers_above=ALWAYS)
    assert called == []
    assert math.isclose(net.early_exit_fractions["layers"], 2 / 3)
    assert net.early_exit_fractions["network"] == 0
    assert not torch.equal(found.means, exact.means)


def test_without_the_network_gaussians_are_those_of_the_prior(net):
    views = wall()
    found = predict(net, views, skip_network_above=ALWAYS)
    prior = net.run_prior(views)
    torch.testing.assert_close(found.opacities, prior.opacity.flatten(1))
    origins = views.cameras.centers[:, :, None, None]
    distance = (found.means.unflatten(1, prior.distance.shape[1:]) - origins).norm(dim=-1)
    torch.testing.assert_close(distance, prior.distance, rtol=1e-4, atol=1e-4)
    assert found.sh.shape[-2] == 1
    assert net.early_exit_fractions == {"network": 1, "layers": 1}
    # The omitted SH bands are 0: the images are those of all bands.
    net.head.decode.weight.data.zero_()
    images = [
        render(gaussians, views.cameras, depth=False).image
        for gaussians in (found, predict(net, views))
    ]
    torch.testing.assert_close(*images)


@pytest.mark.medium
def test_presets_skip_where_the_prior_is_confident(net, composed):
    textured = wall()
    flat = replace(textured, images=torch.full_like(textured.images, 0.4))
    skipped = {}
    for name in ("balanced", "fast"):
        net.early_exit = instantiate(composed(f"speed={name}").speed)
        for scene, views in (("flat", flat), ("textured", textured)):
            with torch.no_grad():
                net(Views(views.cameras, views.images))
            skipped[name, scene] = net.early_exit_fractions["layers"]
    assert skipped["balanced", "flat"] == skipped["fast", "flat"] == 0
    assert skipped["balanced", "textured"] > 0.3
    assert skipped["fast", "textured"] == 1


def test_a_bad_override_is_one_sentence(composed):
    config = composed("speed=fast", "speed.skip_network_above=2.0")
    with pytest.raises(InstantiationException) as caught:
        instantiate(config.speed)
    sentence = "speed.skip_network_above=2.0 should be less than or equal to 1."
    assert str(input_error_behind(caught.value)) == sentence


def test_early_exit_needs_a_prior_and_one_scene(build, net):
    blind = build(*NETWORK, "model=asysplat_4m4s").eval()
    blind.check_early_exit(EXACT)
    with pytest.raises(InputError, match="has no prior"):
        predict(blind, wall(), skip_layers_above=ALWAYS)
    with pytest.raises(InputError, match="2 scenes at a time"):
        scenes = Views.stack([wall()] * 2).map(lambda tensor: tensor[:, 0])
        predict(net, scenes, skip_layers_above=ALWAYS)
