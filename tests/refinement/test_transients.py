"""What stands in one photograph only leaves no ghost; where many are fitted badly, all counts."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from asysplat.evaluation.metrics import psnr
from asysplat.refinement import DEFAULT, refine
from asysplat.refinement.init import initial_gaussians
from asysplat.refinement.transients import find_transients
from asysplat.rendering import render

IN = [1, 5, 9]  # photographs in which something stands in the way, elsewhere in the room each time


@pytest.fixture(scope="module")
def where(room):
    inside = torch.zeros_like(room[0].images[:, 0], dtype=torch.bool)
    inside[IN, 15:32, 2:20] = True
    return inside


@pytest.fixture(scope="module")
def passed(room, where):
    """The photographs of a room, with what stands in the way."""
    color = torch.tensor([0.9, 0.1, 0.8])[:, None, None]
    return replace(room[0], images=torch.where(where[:, None], color, room[0].images))


@pytest.mark.medium
def test_what_stands_in_one_photograph_leaves_no_ghost_and_no_hole(room, where, passed):
    views, quality = room[0], {}
    fit_all = replace(DEFAULT, robust=False)
    fits = {"all": (passed, fit_all), "found": (passed, DEFAULT)}
    fits["known"] = (replace(passed, masks=~where), fit_all)
    for name, (photographs, settings) in fits.items():
        start, values = initial_gaussians("plane_sweep", photographs, settings.initial_limit), []
        for seed in (0, 1):
            scene = refine(start, photographs, settings, steps=400, seed=seed)
            image = render(scene, views.cameras.select(IN), views.mean_color()).image
            values.append(psnr(image, views.images[IN], where[IN]).mean().item())
        quality[name] = sum(values) / len(values)
    assert quality["found"] > quality["all"] + 0.5, quality
    assert quality["found"] > quality["known"] - 0.5, quality


def differences(rendered, views):
    return (views.masked(rendered) - views.images).split(1)


def test_pixels_that_renderings_contradict_are_found(room, where, passed):
    found = find_transients(differences(room[0].images, passed))
    assert found is not None and found[where].all()
    borders = F.max_pool2d(where.float(), 3, stride=1, padding=1) > 0
    assert not found[~borders].any()


def test_none_are_found_where_no_rendering_is_wrong_or_all_are(room, passed):
    images = room[0].images
    assert find_transients(differences(images, room[0])) is None
    assert find_transients(differences(torch.zeros_like(images), passed)) is None


def test_masks_of_the_user_stay(where, passed):
    given = torch.ones_like(where)
    given[:, :20] = False
    masks = replace(passed, masks=given).without(where).masks
    assert masks is not None and masks.equal(given & ~where)
