"""Log the speed and the memory of a training, its gradients and its Gaussians; watch its loss."""

import math
import statistics
import time
import warnings
from collections import defaultdict
from typing import Any

import torch
from lightning import Callback, Trainer
from torch import Tensor, nn
from torch.optim import Optimizer

from asysplat.evaluation.measured_cost import peak_memory_gb
from asysplat.training.loggers import log_histogram, log_numbers
from asysplat.training.module import SplattingModule
from asysplat.training.parallel import Batch, Prediction

MIN_ALPHA = 0.5  # the depth of a pixel with less coverage is not counted
INTERVALS = 10  # intervals that the band of the loss is made of; it begins with half as many
MIN_FACTOR, MIN_DEVIATIONS = 2.0, 6.0  # above the median, at least: its multiple, and deviations
SAMPLES = 10_000  # values of a validation scene in a histogram, at least, if it has as many


class TrainingMonitor(Callback):
    """Logs the costs of every `every` steps and statistics of each validation's Gaussians.

    - time/: views_per_second and seconds_per_step, without validations.
    - memory/: peak_gb, see `peak_memory_gb`.
    - gradient/: the norm of each part of the network, before it is clipped.
    - gaussians/: histograms and medians, over the scenes of the first process, of opacities, of
      scales (the geometric mean of a Gaussian's three) and of rendered depths at the targets.

    Warns when the median loss of `every` steps leaves its `LossBand`.
    """

    def __init__(self, every: int = 50):
        self.every, self.band = every, LossBand()

    def state_dict(self) -> dict[str, Any]:
        return {"losses": self.band.losses, "is_outside": self.band.is_outside}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.band.losses = list(state_dict["losses"])
        self.band.is_outside = state_dict["is_outside"]

    def on_train_start(self, *_: object) -> None:
        self.seconds, self.views, self.steps = 0.0, 0, 0
        self.losses: list[Tensor] = []
        self.since = time.perf_counter()

    def on_train_epoch_start(self, *_: object) -> None:
        self.since = time.perf_counter()

    def on_before_optimizer_step(
        self, trainer: Trainer, module: SplattingModule, _: Optimizer
    ) -> None:
        self.steps += 1
        if (trainer.global_step + 1) % self.every == 0:
            log_numbers(trainer, gradient_norms(module.net), trainer.global_step)

    def on_train_batch_end(
        self, trainer: Trainer, module: SplattingModule, _: object, batch: Batch, *__: object
    ) -> None:
        now = time.perf_counter()
        self.seconds, self.since = self.seconds + now - self.since, now
        views = batch["inputs"].num_views + batch["targets"].num_views
        self.views += len(batch["scene"]) * views * trainer.world_size
        if self.steps > len(self.losses):  # the last micro-batch of a step
            self.losses.append(trainer.callback_metrics["train/loss"])
        if self.steps == self.every:
            self._watch_loss(trainer)
            values = {
                "time/views_per_second": self.views / self.seconds,
                "time/seconds_per_step": self.seconds / self.steps,
                "memory/peak_gb": peak_memory_gb(module.device),
            }
            log_numbers(trainer, values, trainer.global_step - 1)
            self.on_train_start()

    def _watch_loss(self, trainer: Trainer) -> None:
        losses = torch.stack(self.losses)
        loss, bound = losses[losses.isfinite()].median().item(), self.band.bound
        if self.band.leaves(loss) and trainer.is_global_zero:
            warnings.warn(
                f"step {trainer.global_step}: the median loss of {self.every} steps is {loss:.3g}, "
                f"and its band, of the steps before, ends at {bound:.3g}; if it does not fall "
                "again, stop, and start from earlier weights with a smaller learning_rate: "
                "init_path=.../checkpoints/best.ckpt, or previous.ckpt.",
                stacklevel=1,
            )

    def on_validation_epoch_start(self, *_: object) -> None:
        self.samples: dict[str, list[Tensor]] = defaultdict(list)

    def on_validation_batch_end(
        self, _: Trainer, __: SplattingModule, outputs: Prediction, *___: object
    ) -> None:
        gaussians, rendering = outputs.gaussians, outputs.rendering
        values = {
            "opacity": gaussians.opacities.flatten(),
            "log10_scale": gaussians.scales.log10().mean(-1).flatten(),
            "log10_depth": rendering.depth[rendering.alpha > MIN_ALPHA].log10(),
        }
        for name, numbers in values.items():
            sample = numbers[:: max(1, len(numbers) // SAMPLES)].float()
            self.samples[name].append(sample[sample.isfinite()].cpu())

    def on_validation_epoch_end(self, trainer: Trainer, module: SplattingModule) -> None:
        for name, samples in self.samples.items():
            values = torch.cat(samples)
            if not len(values):
                continue
            medians = {f"gaussians/{name}_median": values.median().item()}
            log_numbers(trainer, medians, trainer.global_step)
            for logger in trainer.loggers:
                log_histogram(logger, f"gaussians/{name}", values, trainer.global_step)


class LossBand:
    """Tells when the median loss of an interval of steps leaves the band of the last INTERVALS.

    The band ends above the median, at MIN_FACTOR times it or at MIN_DEVIATIONS median absolute
    deviations, whichever is higher: noise, and a task that slowly gets harder, are within. Medians
    of steps, as a few hard scenes raise a mean.
    """

    def __init__(self):
        self.losses: list[float] = []  # medians of the last intervals
        self.is_outside = False

    @property
    def bound(self) -> float:
        """Upper end of the band; infinite until there are half as many intervals."""
        if 2 * len(self.losses) < INTERVALS:
            return math.inf
        median = statistics.median(self.losses)
        deviation = statistics.median(abs(loss - median) for loss in self.losses)
        return max(MIN_FACTOR * median, median + MIN_DEVIATIONS * deviation)

    def leaves(self, loss: float) -> bool:
        """Add the next interval's loss; return whether it, and not the one before, is outside.

        An interval without a finite loss, NaN, is left out.
        """
        if math.isnan(loss):
            return False
        was_outside, self.is_outside = self.is_outside, loss > self.bound
        self.losses = [*self.losses, loss][-INTERVALS:]
        return self.is_outside and not was_outside


def gradient_norms(net: nn.Module) -> dict[str, float]:
    """Compute the gradient's norm of each part of a network that has a gradient."""
    norms = {}
    for name, part in net.named_children():
        grads = [p.grad for p in part.parameters() if p.grad is not None]
        if grads:
            norms[f"gradient/{name}"] = torch.nn.utils.get_total_norm(grads).item()
    return norms
