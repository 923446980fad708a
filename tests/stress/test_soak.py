"""Long runs: make slow. test_checked.py runs the first with bounds checks in poisoned memory."""

import gc
import os
from pathlib import Path

import numba
import pytest
import torch
from backends import FAST, assert_same_bits, both_ways
from poison import FILLS, poisoned

from asysplat import load, open_photographs, refine, render
from asysplat.data import ProceduralScene
from asysplat.evaluation.metrics import mean_color_images, psnr
from asysplat.refinement import DEFAULT
from asysplat.refinement.init import initial_gaussians

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


@pytest.mark.parametrize("scene", ["fern", "fox", "mydesk", "hololens-000"])
def test_a_thousand_steps_have_finite_gradients_and_better_images(shared, scene):
    non_finite = []

    def watch(_, refinement) -> bool:
        non_finite.append(refinement.fields.optimizer.non_finite)
        return False

    with poisoned(FILLS[0] if numba.config.BOUNDSCHECK else None):
        folder = str(shared / "data" / scene)
        views = open_photographs(folder, 256, 256, held_out_every=None).inputs
        start = initial_gaussians("plane_sweep", views, DEFAULT.initial_limit)
        end = refine(start, views, steps=1000, watch=watch).validate()
        assert len(non_finite) == 1000 and non_finite[-1] == 0
        runs = [both_ways(FAST[0], end, views.cameras.map(lambda t: t[:2])) for _ in range(2)]
        assert_same_bits(*runs)
        assert runs[0].stats == runs[1].stats
        images = [render(gaussians, views.cameras).image for gaussians in (start, end)]
    images.append(mean_color_images(views, views))
    before, after, flat = (psnr(image, views.images).mean().item() for image in images)
    assert after > before + 1 and after > flat + 1


@pytest.mark.parametrize("call", ["render", "refine", "load"])
def test_memory_stays_flat_over_a_thousand_calls(call):
    views = ProceduralScene(0, 48, 64, 4).views(range(4))
    gaussians = load("shipped")(views)
    gaussians = gaussians.keep(torch.arange(gaussians.num_gaussians) % 50 == 0)
    calls = {
        "render": lambda: render(gaussians, views.cameras),
        "refine": lambda: refine(gaussians, views, steps=1),
        "load": lambda: load("shipped"),
    }
    sizes = []
    for number in range(1000):
        calls[call]()
        if number % 100 >= 90:  # it takes longer than a call
            gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        sizes.append(pages * os.sysconf("SC_PAGESIZE") / 1e6)
    assert max(sizes[-10:]) - max(sizes[190:200]) < 20  # MB
