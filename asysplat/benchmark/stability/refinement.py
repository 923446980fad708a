"""Refinement from Gaussians that nobody would start from."""

from collections.abc import Iterator
from functools import partial

import torch
import torch.nn.functional as F

from asysplat.benchmark.stability.judge import Case, line
from asysplat.benchmark.stability.renderer import FIELDS, GAUSSIANS, Change, gaussians_before
from asysplat.benchmark.stability.views import Hostile
from asysplat.benchmark.timing import Result
from asysplat.refinement import Refinement, RefinementProgress, refine
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views

AREA = "refinement"


def cases(steps: int) -> Iterator[Case]:
    """Yield a refinement of so many steps from each hostile start."""
    for name, change in GAUSSIANS.items():
        yield Case(AREA, f"from Gaussians {name}", "fp32", partial(_measure, change, steps))


def _measure(change: Change, steps: int) -> Result:
    """Refine Gaussians that were changed to photographs of what they were."""
    cameras = Hostile().cameras()
    gaussians = gaussians_before(cameras)
    views = Views(cameras, render(gaussians, cameras, depth=False).image.clamp(0, 1))
    start = change(gaussians, cameras)
    skipped: list[int] = []

    def watch(_: RefinementProgress, refinement: Refinement) -> bool:
        skipped[:] = [refinement.fields.skipped]
        return False

    background = torch.zeros(3)
    end = refine(start, views, steps=steps, background=background, watch=watch)
    end.validate("the refined Gaussians")
    before, after = _psnr(start, views), _psnr(end, views)
    return line(
        f"PSNR of the photographs: {before:.1f} dB, after {steps:,} steps {after:.1f} dB; "
        f"{skipped[0]} gradients not finite",
        {name: getattr(end, name) for name in FIELDS},
        green=after >= before and skipped[0] == 0,
        steps=steps,
    )


def _psnr(gaussians: Gaussians, views: Views) -> float:
    image = render(gaussians, views.cameras, depth=False).image
    return -10 * F.mse_loss(image.double(), views.images.double()).clamp_min(1e-10).log10().item()
