"""Measurements of the paper's post-optimization: quality, costs, invalid steps."""

import itertools
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


def psnrs(result, images):
    """The mean PSNR of each step's images."""
    return [
        torch.tensor([r["psnr"] for r in result.rows if (r["images"], r["method"]) == (images, s)])
        .mean()
        .item()
        for s in result.costs
    ]


def test_psnr_of_inputs_rises_with_every_step(scene):
    gaussians, inputs, targets = scene
    measure = PostOptimization(range(29), PROTOCOL, None, BLACK)
    result = measure("synthetic", lambda _: gaussians, inputs, targets)
    of_inputs, of_targets = (psnrs(result, images) for images in ("inputs", "targets"))
    assert len(of_inputs) == 29
    assert all(b > a for a, b in itertools.pairwise(of_inputs))
    assert of_inputs[28] > of_inputs[0] + 1 and of_targets[28] > of_targets[0] + 0.5
    assert result.gaussians == 60


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


def test_post_optimization_has_a_row_with_metrics_for_every_image(scene):
    gaussians, inputs, targets = scene
    result = PostOptimization((0, 2), PROTOCOL, None)("a", lambda _: gaussians, inputs, targets)
    counts = {
        key: sum((r["images"], r["method"]) == key for r in result.rows)
        for key in itertools.product(
            ("targets", "inputs"), ("post0", "post2", "nearest_view", "mean_color")
        )
    }
    assert list(counts.values()) == [2, 2, 2, 2, 4, 4, 0, 0]
    (first, *_) = (r for r in result.rows if r["method"] == "post0")
    assert {"psnr", "ssim", "absrel", "delta1"} <= first.keys()


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
