"""Training on hostile batches, and refinement from hostile Gaussians."""

import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import hydra
import torch
import torch.nn.functional as F
from hydra.utils import instantiate

from asysplat.refinement import Refinement, RefinementProgress, refine
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views
from asysplat.training.module import SplattingModule
from benchmarks.scenes import DISTANCE
from benchmarks.stability.comparison import ALL_PRECISIONS, StabilityCase, make_row
from benchmarks.stability.hostile import (
    FIELDS,
    FOCALS,
    HOSTILE_GAUSSIANS,
    IMAGES,
    POSES,
    HostileViews,
    hostile_gaussians,
    scattered_gaussians,
)
from benchmarks.timing import Result

SMALL = ("width=0.125", "state_size=8", "model.layers=1m1s")
COUNTS = (1, 2, 4)  # numbers of views in a batch
DEPTHS = (0.0, 1e-3, DISTANCE, 1e6)  # a depth for all pixels; 0 is unknown


def training_cases(models: Sequence[str], steps: int) -> Iterator[StabilityCase]:
    """Yield a training of `steps` steps for each model, in fp32 and in bf16."""
    for precision in ("fp32", "bf16"):
        for model in models:
            name = f"{model}, {steps:,} steps on hostile batches"
            run = partial(_measure_training, model, precision, steps)
            yield StabilityCase(name, precision, run)


def _measure_training(model: str, precision: str, steps: int) -> Result:
    """Train as train.py does, but write no files; steps with non-finite gradients are skipped."""
    overrides = [f"model={model}", "scale=laptop", f"steps={steps}", *SMALL]
    config = hydra.compose("train", overrides)
    torch.manual_seed(0)
    module: SplattingModule = instantiate(config.training, net=instantiate(config.model)).train()
    optimizers = module.configure_optimizers()
    optimizer, schedule = optimizers["optimizer"], optimizers["lr_scheduler"]["scheduler"]
    losses, norms = [], []
    dtype = ALL_PRECISIONS[precision]
    for batch in hostile_batches(steps):
        optimizer.zero_grad()
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            prediction = module(batch, depth=module.loss.needs_depth)
            loss = module.loss(prediction, batch)["loss"]
        loss.backward()
        grads = [p.grad for p in module.parameters() if p.grad is not None]
        losses.append(loss.detach())
        norms.append(torch.nn.utils.get_total_norm(grads))
        if not norms[-1].isfinite():
            optimizer.zero_grad()
        module.configure_gradient_clipping(optimizer, config.trainer.gradient_clip_val)
        optimizer.step()
        schedule.step()
    results = {"losses": torch.stack(losses), "norms of gradients": torch.stack(norms)}
    results |= dict(module.named_parameters())
    compared = f"nothing; losses, norms of gradients and weights are finite, {steps:,} steps"
    return make_row(compared, results, green=True, steps=steps)


def hostile_batches(steps: int) -> Iterator[dict[str, Views]]:
    """Yield `steps` batches of one scene, with randomly chosen hostile properties."""
    kinds = list(product(IMAGES, POSES, FOCALS.values(), COUNTS))
    order = random.Random(0)
    for _ in range(steps):
        views = HostileViews(*order.choice(kinds)).views()
        depth = order.choice(DEPTHS)
        views = replace(views, depths=torch.full_like(views.images[:, 0], depth))
        views = views.map(lambda tensor: tensor[None])
        yield {"inputs": views, "targets": views}


def refinement_cases(steps: int) -> Iterator[StabilityCase]:
    """Yield a refinement of `steps` steps from each of the hostile Gaussians."""
    for name in HOSTILE_GAUSSIANS:
        run = partial(_measure_refinement, name, steps)
        yield StabilityCase(f"from Gaussians {name}", "fp32", run)


def _measure_refinement(name: str, steps: int) -> Result:
    """Refine hostile Gaussians against renderings of the Gaussians that they were made from."""
    cameras = HostileViews().cameras()
    gaussians = scattered_gaussians(cameras)
    views = Views(cameras, render(gaussians, cameras, depth=False).image.clamp(0, 1))
    start = hostile_gaussians(name, gaussians, cameras)
    non_finite = 0

    def watch(_: RefinementProgress, refinement: Refinement) -> bool:
        nonlocal non_finite
        non_finite = refinement.fields.optimizer.non_finite
        return False

    end = refine(start, views, steps=steps, background=torch.zeros(3), watch=watch)
    end.validate("the refined Gaussians")
    before, after = _psnr(start, views), _psnr(end, views)
    return make_row(
        f"PSNR of the photographs: {before:.1f} dB, after {steps:,} steps {after:.1f} dB; "
        f"{non_finite} gradients not finite",
        {name: getattr(end, name) for name in FIELDS},
        green=after >= before and non_finite == 0,
        steps=steps,
    )


def _psnr(gaussians: Gaussians, views: Views) -> float:
    image = render(gaussians, views.cameras, depth=False).image
    return -10 * F.mse_loss(image.double(), views.images.double()).clamp_min(1e-10).log10().item()
