"""The depths that a refinement keeps: those that other views confirm, as far as they are right."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.models.prior.prior import DepthEstimate
from asysplat.ops.plane_sweep import Consistency
from asysplat.refinement import DEFAULT, Refinement, init, refine
from asysplat.refinement.init import KnownDepths, initial_gaussians, sweep
from asysplat.rendering import render

CONFIDENCE = torch.tensor([[0.9, 0.8, 0.4], [1.0, 0.6, 0.7]])
INVERSE = torch.tensor([[0.5, 0.25, 0.5], [1.0, 0.0, 0.5]])
NO_VOTES = Consistency(*torch.zeros(4, 1, 2, 2, 3))


@pytest.fixture(scope="module")
def scene():
    """Views of an outdoor scene, whose sky and ground have little texture."""
    return ProceduralScene(7, 64, 64, num_images=9, places="outdoors").views(range(9))


def test_the_error_by_hand(scene, monkeypatch):
    """Of six pixels one is unsure, one is unknown, one has no Gaussian, and one is far off."""
    maps = (values.expand(1, 2, 2, 3) for values in (INVERSE, CONFIDENCE))
    monkeypatch.setattr(init, "DEPTH_VIEWS", 2)
    known = KnownDepths(scene, DepthEstimate(*maps, NO_VOTES))
    depth = torch.tensor([[[2.2, 0.0, 7.0], [3.0, 2.0, 1.8]]], requires_grad=True)
    expected = 0.9 * torch.tensor(1.1).log() + 0.5 - 0.7 * torch.tensor(0.9).log()
    torch.testing.assert_close(known.error(depth, 0), expected / 6)
    (slope,) = torch.autograd.grad(known.error(depth, 0), depth)
    assert (slope != 0).tolist() == [[[True, False, False], [False, False, True]]]
    assert known.error(depth, 1) == 0  # DEPTH_VIEWS is 2: the first and the last view are swept


def test_steps_keep_depths_that_are_known(scene):
    """In 100 steps photographs alone, which are not sure, move surfaces farther from them."""
    known, errors = KnownDepths(scene, sweep(scene)), {}
    for weight in (0.0, 0.1):
        settings = replace(DEFAULT, depth=weight, densify="none")
        start = initial_gaussians("plane_sweep", scene, settings.initial_limit)
        found = refine(start, scene, settings, steps=100)
        with torch.no_grad():
            depth = render(found, scene.cameras, scene.mean_color()).depth
        of_views = [known.error(depth[[view]], view) for view in range(scene.num_views)]
        errors[weight] = torch.stack(of_views).mean().item()
    assert errors[0.1] < 0.75 * errors[0.0]


def test_the_cool_down_is_left_to_the_photographs(scene):
    refinement = Refinement(initial_gaussians("plane_sweep", scene, DEFAULT.initial_limit), scene)
    for _ in range(2):
        refinement.step(1 - DEFAULT.cool_down / 2)
    assert "_known_depths" not in vars(refinement)
    refinement.step(0.1)
    assert "_known_depths" in vars(refinement)
