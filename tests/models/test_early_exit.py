"""Skips of a prediction: off is exact, each leaves out what it says and no more, and counts it."""

import math
from dataclasses import fields, replace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from test_prior import wall
from tiny import NETWORK

from asysplat.errors import InputError, input_error_behind
from asysplat.models import BiMamba2, EarlyExit
from asysplat.models.coverage import covering_views, seen_samples
from asysplat.models.early_exit import EXACT
from asysplat.models.prior import Prior
from asysplat.rendering import render
from asysplat.scene import Views

ALWAYS = 1e-6  # a confidence that every scene has of which anything is known
NEVER = 1.0  # one that no scene has


@pytest.fixture
def net(build):
    """A network of three stages with two layers each, whose head corrects the prior visibly."""
    net = build(*NETWORK).eval()
    torch.nn.init.normal_(net.head.decode.weight, std=0.05)
    return net


def preset(repository, name):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        return instantiate(compose("train", [f"speed={name}"]).speed)


@torch.no_grad()
def predict(net, views, **thresholds):
    net.early_exit = EarlyExit(**thresholds)
    return net(views)


def same_bits(one, other):
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)]
    return all(torch.equal(a, b) for a, b in pairs)


def test_off_is_exact_and_counts_nothing(net, repository):
    exact = predict(net, wall())
    assert preset(repository, "exact") == EXACT == net.early_exit
    assert net.skipped == {}
    assert same_bits(exact, net.predict(wall()))


@pytest.mark.parametrize(
    "thresholds", [{"sure": NEVER}, {"known": NEVER}, {"faint": 1e-9}], ids=str
)
def test_a_threshold_that_no_scene_reaches_changes_no_bit(net, thresholds):
    exact = predict(net, wall())
    assert same_bits(exact, predict(net, wall(), **thresholds))
    assert set(net.skipped.values()) == {0.0}


def test_training_skips_nothing(net):
    net.early_exit = EarlyExit(known=ALWAYS)
    torch.manual_seed(0)
    assert net.train()(wall()).sh.shape[-2] == net.head.sh_bands
    assert net.skipped == {}


def test_sure_leaves_out_scans_and_middle_stages(net):
    called = []
    for module in net.modules():
        if module in net.dispensable or isinstance(module, BiMamba2):
            module.register_forward_hook(lambda module, *_: called.append(module))
    exact = predict(net, wall())
    assert set(called) == set(net.dispensable)
    called.clear()
    found = predict(net, wall(), sure=ALWAYS)
    assert called == []
    # Of 3 stages with a scan, an attention and two layers of MambaVision: all but 2 attentions.
    assert math.isclose(net.skipped["layers"], 10 / 12)
    assert net.skipped["views"] == net.skipped["gaussians"] == net.skipped["bands"] == 0
    assert not torch.equal(found.means, exact.means)


def test_known_hands_over_the_prior(net):
    views = wall()
    found = predict(net, views, known=ALWAYS)
    prior = net.ask(views)
    torch.testing.assert_close(found.opacities, prior.opacity.flatten(1))
    distance = (found.means.unflatten(1, prior.distance.shape[1:]) - origins(views)).norm(dim=-1)
    torch.testing.assert_close(distance, prior.distance, rtol=1e-4, atol=1e-4)
    assert found.sh.shape[-2] == 1
    assert net.skipped == {"views": 1, "layers": 1, "gaussians": 0, "bands": 0.75}
    # SH bands that were left out are 0: the pictures are those of all bands.
    net.head.decode.weight.data.zero_()
    torch.testing.assert_close(drawn(found, views), drawn(predict(net, views), views))


def origins(views):
    return views.cameras.centers[:, :, None, None]


def drawn(gaussians, views):
    return render(gaussians, views.cameras, depth=False).image


def test_views_that_add_nothing_keep_the_gaussians_of_the_prior(net):
    once = wall()
    views = once.select([0, 1, 2, 3, 3])
    found = predict(net, views, coverage=0.6)
    prior = net.ask(views)
    looked = covering_views(prior, views.cameras, 0.6)
    assert 3 not in looked or 4 not in looked
    left = sorted({0, 1, 2, 3, 4} - set(looked))
    opacities = found.opacities.unflatten(1, prior.opacity.shape[1:])
    torch.testing.assert_close(opacities[:, left], prior.opacity[:, left])
    assert not torch.isclose(opacities[:, looked], prior.opacity[:, looked]).all()
    assert math.isclose(net.skipped["views"], len(left) / 5)


def a_prior(views, confidence):
    shape = (1, views.num_views, 16, 16)
    length = views.cameras.resized(16, 16).pixel_directions().norm(dim=-1)
    return Prior(2 * length, torch.full(shape, confidence), torch.full(shape, 0.5))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 1.0])
def test_what_is_chosen_covers_its_share(share):
    views = wall(views=6, step=0.4)
    prior = a_prior(views, confidence=0.9)
    chosen = covering_views(prior, views.cameras, share)
    sees = seen_samples(prior, views.cameras)
    assert sees[chosen].any(0).float().mean() >= share
    assert chosen == sorted(set(chosen))
    if share < 1:
        assert len(chosen) < 6


def test_nobody_stands_for_a_view_that_is_not_sure():
    views = wall(views=3, step=0.0)
    assert len(covering_views(a_prior(views, 0.9), views.cameras, 1.0)) == 1
    assert covering_views(a_prior(views, 0.1), views.cameras, 1.0) == [0, 1, 2]


def test_faint_gaussians_are_dropped_within_the_bound(net):
    views = wall()
    exact = predict(net, views)
    threshold = exact.opacities.quantile(0.3).item()
    found = predict(net, views, faint=threshold)
    assert found.opacities.min() >= threshold
    assert torch.equal(found.opacities, exact.opacities[exact.opacities >= threshold][None])
    assert math.isclose(net.skipped["gaussians"], 0.3, abs_tol=0.01)
    loudest = exact.opacities[0].argmax().item()
    alone = exact.map(lambda field: field[:, loudest : loudest + 1])
    weight = render(alone, views.cameras, depth=False).alpha
    assert 0 < weight.max() <= alone.opacities.item() + 1e-6


def test_scenes_differ_in_what_they_need(net, repository):
    """Of a wall with texture the prior is sure, of one without it is not: and the skips say so."""
    textured = wall()
    flat = replace(textured, images=torch.full_like(textured.images, 0.4))
    shares = {}
    for name in ("balanced", "fast"):
        net.early_exit = preset(repository, name)
        for scene, views in (("flat", flat), ("textured", textured)):
            with torch.no_grad():
                net(Views(views.cameras, views.images))
            shares[name, scene] = net.skipped["layers"]
    assert shares["balanced", "flat"] == shares["fast", "flat"] == 0
    assert shares["balanced", "textured"] > 0.3
    assert shares["fast", "textured"] == 1


@pytest.mark.parametrize("value", [0.0, -0.1, 1.5, float("nan")], ids=str)
@pytest.mark.parametrize("name", [field.name for field in fields(EarlyExit)])
def test_bad_thresholds_are_refused(name, value):
    with pytest.raises(InputError, match=rf"speed\.{name}=.*above 0 and up to 1"):
        EarlyExit(**{name: value})


def test_a_bad_override_is_one_sentence(repository):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        config = compose("train", ["speed=fast", "speed.known=2.0"])
    with pytest.raises(Exception, match=r"speed\.known=2\.0") as caught:
        instantiate(config.speed)
    assert isinstance(input_error_behind(caught.value), InputError)


def test_skips_need_a_prior_and_one_scene(build, net):
    blind = build(*NETWORK, "model=asysplat_4m4s").eval()
    blind.check_early_exit(EXACT)
    with pytest.raises(InputError, match="has no prior"):
        predict(blind, wall(), sure=ALWAYS)
    with pytest.raises(InputError, match="2 scenes at a time"):
        predict(net, Views.stack([wall()] * 2).map(lambda tensor: tensor[:, 0]), sure=ALWAYS)
