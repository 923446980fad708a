"""Photographs that come while a refinement goes on."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.data.normalize import normalize
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.refinement import DEFAULT, Refinement
from asysplat.refinement.init import initial_gaussians
from asysplat.rendering import render


@pytest.fixture(scope="module")
def walk():
    """Photographs of the first and of the second half of a walk, and those held out of each."""
    scene = ProceduralScene(5, 48, 48, num_images=64, places="rooms")
    frames = range(0, 64, 4), range(2, 64, 8)
    views, held_out, _ = normalize(*(scene.views(each) for each in frames))
    plain = [replace(each, depths=None, masks=None) for each in (views, held_out)]
    return [
        [each.select(range(n // 2)), each.select(range(n // 2, n))]
        for each, n in zip(plain, (16, 8), strict=True)
    ]


def advance(refinement, steps, start, end):
    for step in range(steps):
        refinement.advance(start + (end - start) * step / steps)


def quality(refinement, views):
    with torch.no_grad():
        image = render(refinement.gaussians, views.cameras, refinement.background).image
    return psnr(image.clamp(0, 1), views.images).mean().item()


def test_what_shows_the_least_makes_room_for_new_places(walk):
    (first, second), (_, of_second) = walk
    settings = replace(DEFAULT, max_gaussians=2000, initial_fraction=0.5)
    start = initial_gaussians("plane_sweep", first, settings.initial_limit)
    refinement = Refinement(start, first, settings=settings)
    advance(refinement, 60, 0.0, 0.65)
    assert len(refinement.fields) == 2000
    unseen = quality(refinement, of_second)
    refinement.add(second)
    assert 1900 < len(refinement.fields) <= 2000
    assert quality(refinement, of_second) > unseen + 0.2


def test_new_places_are_started_and_old_ones_kept(walk):
    (first, second), (of_first, of_second) = walk
    settings = replace(DEFAULT, max_gaussians=8000)
    start = initial_gaussians("plane_sweep", first, settings.initial_limit)
    refinement = Refinement(start, first, settings=settings)
    advance(refinement, 150, 0.0, 0.5)
    before, unseen, count = (
        quality(refinement, of_first),
        quality(refinement, of_second),
        len(refinement.fields),
    )
    refinement.add(second)
    assert refinement.views.num_views == 16 and len(refinement.fields) > count
    started = quality(refinement, of_second)
    advance(refinement, 300, 0.5, 1.0)
    after = [quality(refinement, views) for views in (of_first, of_second)]
    assert started > unseen + 0.3
    assert after[1] > unseen + 3
    assert after[0] > before - 0.2


def test_what_does_not_fit_is_refused(walk):
    (first, second), _ = walk
    refinement = Refinement(initial_gaussians("plane_sweep", first, 500), first)
    with pytest.raises(InputError, match="one size"):
        refinement.add(second.resized(24, 24))
    assert refinement.views.num_views == 8
