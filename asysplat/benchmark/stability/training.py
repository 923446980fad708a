"""A tiny network in training, of which every batch is hostile."""

import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import hydra
import torch
from hydra.utils import instantiate

from asysplat.benchmark.scenes import DISTANCE
from asysplat.benchmark.stability.judge import ALL_PRECISIONS, Case, line
from asysplat.benchmark.stability.views import FOCALS, PHOTOGRAPHS, POSES, Hostile
from asysplat.benchmark.timing import Result
from asysplat.scene import Views
from asysplat.training.module import SplattingModule

AREA = "training"
TINY = ("width=0.125", "state_size=8", "model.layers=1m1s")
COUNTS = (1, 2, 4)  # of views
DEPTHS = (0.0, 1e-3, DISTANCE, 1e6)  # of all pixels; 0 is unknown


def cases(models: Sequence[str], steps: int) -> Iterator[Case]:
    """Yield a training of so many steps for each model, in fp32 and in bf16."""
    for precision in ("fp32", "bf16"):
        for model in models:
            name = f"{model}, {steps:,} steps on hostile batches"
            yield Case(AREA, name, precision, partial(_measure, model, precision, steps))


def _measure(model: str, precision: str, steps: int) -> Result:
    """Train as train.py does, without what a run writes; count steps that are not finite.

    Such a step's gradients are dropped, as the guard of a training does.
    """
    overrides = [f"model={model}", "scale=laptop", f"steps={steps}", *TINY]
    config = hydra.compose("train", overrides)
    torch.manual_seed(0)
    module: SplattingModule = instantiate(config.training, net=instantiate(config.model)).train()
    made = module.configure_optimizers()
    optimizer, schedule = made["optimizer"], made["lr_scheduler"]["scheduler"]
    losses, norms = [], []
    dtype = ALL_PRECISIONS[precision]
    for batch in hostile_batches(steps):
        optimizer.zero_grad()
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            outcome = module.reconstruct(batch, depth=module.loss.needs_depth)
            loss = module.loss(outcome, batch)["loss"]
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
    return line(compared, results, ["norms of gradients"], green=True, steps=steps)


def hostile_batches(steps: int) -> Iterator[dict[str, Views]]:
    """Yield so many batches of one scene, each of kinds that are chosen at random."""
    kinds = list(product(PHOTOGRAPHS, POSES, FOCALS.values(), COUNTS))
    order = random.Random(0)
    for _ in range(steps):
        photographs, poses, focal, count = order.choice(kinds)
        views = Hostile(photographs, poses, focal, count).views()
        depth = order.choice(DEPTHS)
        views = replace(views, depths=torch.full_like(views.images[:, 0], depth))
        views = views.map(lambda tensor: tensor[None])
        yield {"inputs": views, "targets": views}
