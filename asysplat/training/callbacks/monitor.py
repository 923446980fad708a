"""Where the seconds and the memory of a run go, what its gradients and its Gaussians look like."""

import statistics
import time
from typing import Any

import lightning
import torch
from torch import nn

from asysplat.evaluation.cost import GB, peak_memory_gb
from asysplat.evaluation.measured_cost import wait_for
from asysplat.evaluation.peak import peak_flops
from asysplat.evaluation.static_cost import forward_flops
from asysplat.training.histogram import Histogram
from asysplat.training.loggers import log_histogram
from asysplat.training.outcome import Outcome
from asysplat.training.parts import PARTS

GIGA = 1e9
PASSES = 3  # forward, and a backward of about twice its products; computing again does not count
MIN_ALPHA = 0.5  # below it, too little of a pixel is covered for its depth to count
# The bounds of what is counted at each validation; of scales and depths the decimal logarithm.
BOUNDS = {"opacity": (0.0, 1.0), "log10_scale": (-5.0, 1.0), "log10_depth": (-2.0, 2.0)}


class TrainingMonitor(lightning.Callback):
    """Measures every so many steps, and the Gaussians of each validation, for the loggers.

    - time/: views_per_second, seconds_per_step and gflops_per_second of all steps since the last
      that was measured; mfu, their share of the device's peak, where that is known; and of the
      measured step share_<part>, of the seconds of its PARTS and of what is left, other.
    - memory/: peak_gb, see `peak_memory_gb`; on a GPU also its share of what there is.
    - gradient/: the norm of each part of the network, before it is clipped.
    - gaussians/: histograms and medians of opacities, of scales (the geometric mean of a
      Gaussian's three) and of depths as rendered at the targets, in units of the farthest input.

    FLOPs are those of the network's products (`true_flops`): of the forward pass, three times.

    Args:
        every: steps between two that are measured.
    """

    def __init__(self, every: int = 50):
        self.every = every
        self.measured: list[dict[str, float]] = []

    def on_fit_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.flops: int | None = None  # of a scene in training, counted when first needed
        self.peak = peak_flops(module.device, trainer.precision)
        # The first step compiles kernels, and counts nowhere.
        self.first_step, self.begun_at = trainer.global_step, None

    def on_train_epoch_start(self, *_: Any) -> None:
        self.waiting_since = time.perf_counter()

    def on_train_batch_start(self, trainer: Any, module: Any, *_: Any) -> None:
        due = self.begun_at is not None and (trainer.global_step + 1) % self.every == 0
        # Of a step of several batches, the first starts it.
        if due and not module.parts.measuring:
            self.step, self.started = trainer.global_step, self.waiting_since
            module.parts.start(module.device)
        if module.parts.measuring:
            module.parts.add("data", time.perf_counter() - self.waiting_since)

    def on_before_backward(self, trainer: Any, module: Any, *_: Any) -> None:
        self.backward = module.parts("backward")
        self.backward.__enter__()

    def on_after_backward(self, *_: Any) -> None:
        self.backward.__exit__(None, None, None)

    def on_before_optimizer_step(self, trainer: Any, module: Any, _: Any) -> None:
        if module.parts.measuring:
            log(trainer, gradient_norms(module.net), self.step)
            wait_for(module.device)
            self.optimizer_since = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, _: int
    ) -> None:
        if self.begun_at is not None:
            self._count(trainer, batch)
        elif trainer.global_step > self.first_step:
            self._begin(trainer)
        if module.parts.measuring and trainer.global_step > self.step:
            wait_for(module.device)
            now = time.perf_counter()
            module.parts.add("optimizer", now - self.optimizer_since)
            found = shares(module.parts.stop(), now - self.started)
            if self.flops is None:
                views = batch["inputs"]
                size = (views.num_views, views.cameras.height, views.cameras.width)
                self.flops = PASSES * forward_flops(module.net, *size)
            found |= self._speed(trainer) | memory(module.device)
            self.measured.append(found)
            log(trainer, found, self.step)
            self._begin(trainer)
        self.waiting_since = time.perf_counter()

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        if self.measured and trainer.is_global_zero:
            names = self.measured[-1]
            print(sentence({n: statistics.fmean(m[n] for m in self.measured) for n in names}))

    def on_validation_epoch_start(self, trainer: Any, module: lightning.LightningModule) -> None:
        self.histograms = {n: Histogram.empty(*b, module.device) for n, b in BOUNDS.items()}

    def on_validation_batch_end(self, trainer: Any, module: Any, outputs: Outcome, *_: Any) -> None:
        gaussians, rendering = outputs.gaussians, outputs.rendering
        self.histograms["opacity"].add(gaussians.opacities)
        self.histograms["log10_scale"].add(gaussians.scales.log10().mean(-1))
        seen = rendering.depth[rendering.alpha > MIN_ALPHA]
        self.histograms["log10_depth"].add(seen.log10())

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        for name, histogram in self.histograms.items():
            histogram.counts = trainer.strategy.reduce(histogram.counts, reduce_op="sum")
            log(trainer, {f"gaussians/{name}_median": histogram.median()}, trainer.global_step)
            for logger in trainer.loggers:
                log_histogram(logger, f"gaussians/{name}", histogram, trainer.global_step)

    def _begin(self, trainer: Any) -> None:
        """Count from now on."""
        self.begun_at, self.seconds, self.scenes, self.views = trainer.global_step, 0.0, 0, 0

    def _count(self, trainer: Any, batch: Any) -> None:
        """Count a batch since `waiting_since`; the views of all processes."""
        scenes = len(batch["scene"])
        views = batch["inputs"].num_views + batch["targets"].num_views
        self.seconds += time.perf_counter() - self.waiting_since
        self.scenes += scenes
        self.views += scenes * views * trainer.world_size

    def _speed(self, trainer: Any) -> dict[str, float]:
        steps = trainer.global_step - self.begun_at
        flops = self.flops * self.scenes / self.seconds
        found = {
            "time/views_per_second": self.views / self.seconds,
            "time/seconds_per_step": self.seconds / steps,
            "time/gflops_per_second": flops / GIGA,
        }
        return found if self.peak is None else found | {"time/mfu": flops / self.peak}


def log(trainer: Any, numbers: dict[str, float], step: int) -> None:
    """Log numbers at once, whatever `log_every_n_steps` says."""
    for logger in trainer.loggers:
        logger.log_metrics(numbers, step=step)


def shares(seconds: dict[str, float], whole: float) -> dict[str, float]:
    """Return the share of each part of a step, and of what is none of them, other."""
    found = {name: seconds.get(name, 0.0) / whole for name in PARTS}
    found["other"] = max(0.0, 1 - sum(found.values()))
    return {f"time/share_{name}": share for name, share in found.items()}


def memory(device: torch.device) -> dict[str, float]:
    """Return the peak memory, and on a GPU its share of what the GPU has."""
    peak = peak_memory_gb(device)
    if device.type != "cuda":
        return {"memory/peak_gb": peak}
    has = torch.cuda.get_device_properties(device).total_memory / GB
    return {"memory/peak_gb": peak, "memory/peak_share": peak / has}


def gradient_norms(net: nn.Module) -> dict[str, float]:
    """Return the gradient's norm of each part of a network that has one."""
    norms = {}
    for name, part in net.named_children():
        grads = [p.grad for p in part.parameters() if p.grad is not None]
        if grads:
            norms[f"gradient/{name}"] = torch.nn.utils.get_total_norm(grads).item()
    return norms


def sentence(means: dict[str, float]) -> str:
    """Write what was measured as a sentence."""
    parts = ", ".join(f"{name} {means[f'time/share_{name}']:.0%}" for name in (*PARTS, "other"))
    mfu = f"{means['time/mfu']:.1%}" if "time/mfu" in means else "not measured"
    return (
        f"a step took {means['time/seconds_per_step']:.3g} s, {means['time/views_per_second']:.0f} "
        f"views/s: {parts}; {means['time/gflops_per_second']:.0f} GFLOP/s, MFU {mfu}; "
        f"{means['memory/peak_gb']:.2f} GB at most"
    )
