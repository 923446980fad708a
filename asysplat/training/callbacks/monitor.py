"""Measure where a training's seconds and memory go, its gradients and its Gaussians."""

import statistics
import time
from collections import defaultdict

import torch
from lightning import Callback, Trainer
from lightning.pytorch.utilities.types import STEP_OUTPUT
from torch import Tensor, nn
from torch.optim import Optimizer

from asysplat.evaluation.measured_cost import memory_gb, peak_flops, peak_memory_gb, wait_for
from asysplat.evaluation.static_cost import true_flops
from asysplat.training.loggers import log_histogram
from asysplat.training.module import SplattingModule
from asysplat.training.parallel_scenes import Batch
from asysplat.training.prediction import Prediction
from asysplat.training.step_timer import PARTS

GIGA = 1e9
PASSES = 3  # forward, and a backward of about twice its products; recomputation does not count
MIN_ALPHA = 0.5  # the depth of a pixel with less coverage is not counted
SAMPLES = 10_000  # values of a validation scene in a histogram, at least, if it has as many


class TrainingMonitor(Callback):
    """Logs the costs of one in `every` steps and statistics of each validation's Gaussians.

    - time/: views_per_second, seconds_per_step and gflops_per_second of all steps since the last
      measured one; mfu, the fraction of the device's peak, where that is known. Of the measured
      step, share_<part> is the fraction of its seconds spent in each of PARTS, share_other in the
      rest.
    - memory/: peak_gb, see `peak_memory_gb`; on a GPU also peak_share, the fraction of its memory.
    - gradient/: the norm of each part of the network, before it is clipped.
    - gaussians/: histograms and medians, over the scenes of the first process, of opacities, of
      scales (the geometric mean of a Gaussian's three) and of depths as rendered at the targets, in
      units of the farthest input.

    FLOPs are three times those of the network's products (`true_flops`) in the forward pass.

    Args:
        every: steps from one measured step to the next.
    """

    def __init__(self, every: int = 50):
        self.every = every
        self.measurements: list[dict[str, float]] = []

    def on_fit_start(self, trainer: Trainer, module: SplattingModule) -> None:
        self.flops: int | None = None  # FLOPs of a training scene, counted when first needed
        self.peak = peak_flops(module.device, trainer.precision)
        # The first step compiles kernels and is not counted.
        self.first_step, self.begin_step = trainer.global_step, None

    def on_train_epoch_start(self, *_: object) -> None:
        self.waiting_since = time.perf_counter()

    def on_train_batch_start(self, trainer: Trainer, module: SplattingModule, *_: object) -> None:
        due = self.begin_step is not None and (trainer.global_step + 1) % self.every == 0
        if due and not module.timer.measuring:  # at the first micro-batch of the step
            self.step, self.started = trainer.global_step, self.waiting_since
            module.timer.start(module.device)
        if module.timer.measuring:
            module.timer.add("data", time.perf_counter() - self.waiting_since)

    def on_before_backward(self, trainer: Trainer, module: SplattingModule, *_: object) -> None:
        self.backward = module.timer("backward")
        self.backward.__enter__()

    def on_after_backward(self, *_: object) -> None:
        self.backward.__exit__(None, None, None)

    def on_before_optimizer_step(
        self, trainer: Trainer, module: SplattingModule, _: Optimizer
    ) -> None:
        if module.timer.measuring:
            log(trainer, gradient_norms(module.net), self.step)
            wait_for(module.device)
            self.optimizer_since = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, module: SplattingModule, outputs: STEP_OUTPUT, batch: Batch, _: int
    ) -> None:
        if self.begin_step is not None:
            self._count(trainer, batch)
        elif trainer.global_step > self.first_step:
            self._begin(trainer)
        if module.timer.measuring and trainer.global_step > self.step:
            wait_for(module.device)
            finished = time.perf_counter()
            module.timer.add("optimizer", finished - self.optimizer_since)
            if self.flops is None:
                views = batch["inputs"]
                size = (views.num_views, views.cameras.height, views.cameras.width)
                self.flops = PASSES * true_flops(module.net, *size)
            seconds, total = module.timer.stop(), finished - self.started
            fractions = {name: spent / total for name, spent in seconds.items()}
            fractions["other"] = max(0.0, 1 - sum(fractions.values()))
            values = {f"time/share_{name}": fraction for name, fraction in fractions.items()}
            values |= self._rates(trainer)
            values["memory/peak_gb"] = peak_memory_gb(module.device)
            if module.device.type == "cuda":
                values["memory/peak_share"] = values["memory/peak_gb"] / memory_gb(module.device)
            self.measurements.append(values)
            log(trainer, values, self.step)
            self._begin(trainer)
        self.waiting_since = time.perf_counter()

    def on_fit_end(self, trainer: Trainer, module: SplattingModule) -> None:
        if self.measurements and trainer.is_global_zero:
            names = self.measurements[-1]
            print(summary({n: statistics.fmean(m[n] for m in self.measurements) for n in names}))

    def on_validation_epoch_start(self, trainer: Trainer, module: SplattingModule) -> None:
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
            log(trainer, {f"gaussians/{name}_median": values.median().item()}, trainer.global_step)
            for logger in trainer.loggers:
                log_histogram(logger, f"gaussians/{name}", values, trainer.global_step)

    def _begin(self, trainer: Trainer) -> None:
        self.begin_step, self.seconds, self.scenes, self.views = trainer.global_step, 0.0, 0, 0

    def _count(self, trainer: Trainer, batch: Batch) -> None:
        """Count the seconds since `waiting_since`, and the scenes and views of a batch."""
        scenes = len(batch["scene"])
        views = batch["inputs"].num_views + batch["targets"].num_views
        self.seconds += time.perf_counter() - self.waiting_since
        self.scenes += scenes
        self.views += scenes * views * trainer.world_size

    def _rates(self, trainer: Trainer) -> dict[str, float]:
        flops = self.flops * self.scenes / self.seconds
        rates = {
            "time/views_per_second": self.views / self.seconds,
            "time/seconds_per_step": self.seconds / (trainer.global_step - self.begin_step),
            "time/gflops_per_second": flops / GIGA,
        }
        return rates if self.peak is None else rates | {"time/mfu": flops / self.peak}


def log(trainer: Trainer, numbers: dict[str, float], step: int) -> None:
    """Log numbers at once, whatever `log_every_n_steps` is."""
    for logger in trainer.loggers:
        logger.log_metrics(numbers, step=step)


def gradient_norms(net: nn.Module) -> dict[str, float]:
    """Return the gradient's norm of each part of a network that has a gradient."""
    norms = {}
    for name, part in net.named_children():
        grads = [p.grad for p in part.parameters() if p.grad is not None]
        if grads:
            norms[f"gradient/{name}"] = torch.nn.utils.get_total_norm(grads).item()
    return norms


def summary(means: dict[str, float]) -> str:
    """Summarize the means of the measurements in a line."""
    parts = ", ".join(f"{name} {means[f'time/share_{name}']:.0%}" for name in (*PARTS, "other"))
    mfu = f"{means['time/mfu']:.1%}" if "time/mfu" in means else "not measured"
    return (
        f"a step took {means['time/seconds_per_step']:.3g} s, {means['time/views_per_second']:.0f} "
        f"views/s: {parts}; {means['time/gflops_per_second']:.0f} GFLOP/s, MFU {mfu}; "
        f"{means['memory/peak_gb']:.2f} GB at most"
    )
