"""Measurements of the paper's post-optimization: quality, costs, invalid steps."""

import time
from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.evaluation.post_optimization import PostOptimization
from asysplat.evaluation.protocol import Protocol
from asysplat.refinement import PAPER, Refinement, refine
from asysplat.rendering import render
from asysplat.scene import Views

SIZE = 24
PROTOCOL = Protocol("test", False, "gaussian", "biased", "alex", "images", "none")
BLACK = torch.zeros(3)


@pytest.fixture(scope="module")
def scene(make_scene):
    """Images of Gaussians, 4 inputs and 2 targets, and a noisy prediction."""
    true, cameras = make_scene(60, 6, SIZE, SIZE, dtype=torch.float32)
    with torch.no_grad():
        drawn = render(true, cameras, BLACK)
    views = Views(cameras, drawn.image.clamp(0, 1), depths=drawn.depth)
    noise = torch.Generator().manual_seed(1)
    off = replace(
        true,
        means=true.means + 0.01 * torch.randn(true.means.shape, generator=noise),
        sh=true.sh + 0.1 * torch.randn(true.sh.shape, generator=noise),
    )
    return off, views.select([0, 1, 3, 4]), views.select([2, 5])


def test_intermediate_steps_equal_a_shorter_refinement(scene):
    gaussians, inputs, targets = scene
    measure = PostOptimization((0, 1, 4, 6), PROTOCOL, None, BLACK)
    result = measure("synthetic", lambda _: gaussians, inputs, targets)
    for steps in (1, 4):
        refined = refine(gaussians, inputs, PAPER, steps=steps, background=BLACK)
        with torch.no_grad():
            image = render(refined, targets.cameras, BLACK).image
        found = [r["psnr"] for r in result.rows if r["method"] == f"post{steps}"][:2]
        assert found == PROTOCOL.psnr(image, targets).tolist(), steps


def test_an_object_is_measured_before_its_background(scene):
    """In every place one is chosen, transparent pixels show it."""
    cameras = scene[2].cameras
    true = replace(scene[0], scales=0.2 * scene[0].scales, sh=0.2 * scene[0].sh)
    with torch.no_grad():
        drawn = render(true, cameras, torch.ones(3))
    views = Views(cameras, drawn.image.clamp(0, 1), alphas=drawn.alpha.clamp(0, 1))
    assert (views.alphas == 0).any()
    for background in (None, BLACK):
        measure = PostOptimization((0,), PROTOCOL, None, background)
        rows = measure("synthetic", lambda _: true, views, views).rows
        assert all(row["psnr"] > 50 for row in rows if row["method"] == "post0")


def test_costs_of_post_optimization_do_not_include_the_metrics(scene, monkeypatch):
    """On a clock that a prediction moves by 1, a step by 10 and a measurement by 100."""
    gaussians, inputs, targets = scene
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def predict(_):
        now[0] += 1
        return gaussians

    def step(self, *arguments):
        now[0] += 10
        return take_step(self, *arguments)

    take_step = Refinement.step
    monkeypatch.setattr(Refinement, "step", step)

    def watch(step, rendering):
        assert (rendering is not None) == (step in (0, 1, 3))
        now[0] += 0 if rendering is None else 100

    result = PostOptimization((0, 1, 3), PROTOCOL, None)("a", predict, inputs, targets, watch)
    seconds = {method: costs["seconds"] for method, costs in result.costs.items()}
    assert seconds == {"post0": 1, "post1": 11, "post3": 31}


@pytest.mark.parametrize("steps", [(), (3, 3)])
def test_steps_of_post_optimization_must_increase(steps):
    with pytest.raises(InputError, match="above the one before"):
        PostOptimization(steps, PROTOCOL, None)
