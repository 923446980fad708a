"""What a run costs: parameters, FLOPs, Gaussians, seconds a step, memory."""

import statistics
import time
from typing import Any

import lightning
import torch

from asysplat.data.datamodule import collate
from asysplat.evaluation.cost import GB, peak_memory_gb, reset_peak_memory
from asysplat.evaluation.render_time import render_seconds, wait_for
from asysplat.evaluation.static_cost import static_costs

WARM_UP_STEPS = 5


class Costs(lightning.Callback):
    """Writes `values`, "cost/..." -> number; what needs no running is known before the first step.

    Of one scene at the run's views and resolution: see `static_costs`. Measured: the median
    training step and the peak of memory over all of them (seconds_per_step, peak_gb), and what that
    is beyond what there was before the first, for each token of the largest patch in a batch
    (peak_bytes_per_token); what a step renders, with its gradients (render_seconds); the median
    forward of the network over the scenes of the test and the peak of memory in it
    (inference_seconds, inference_gb). The last two of a further test set, whose views may be more
    or larger, are "cost/<its name>/...".
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}
        self.seconds: list[float] = []
        self.forwards: list[float] = []

    def on_fit_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        # Jobs of a sweep share a process, and the peak would be that of the largest.
        reset_peak_memory(module.device)
        self.gb_before = peak_memory_gb(module.device)
        scene = trainer.datamodule.evaluation["val"][0]["inputs"]
        height, width = scene.images.shape[-2:]
        tokens = scene.num_views * height * width // module.net.patch**2
        self.batch_tokens = trainer.datamodule.batch_size * tokens
        costs = static_costs(module.net, scene.num_views, height, width)
        self.values = {f"cost/{name}": value for name, value in costs.items()}
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=0)

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        self._start(module)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        self.seconds.append(self._elapsed(module))

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        measured = self.seconds[WARM_UP_STEPS:]
        if measured:
            self.values["cost/seconds_per_step"] = statistics.median(measured)
            self.values["cost/render_seconds"] = self._render_seconds(trainer, module)
        peak = peak_memory_gb(module.device)
        per_token = GB * (peak - self.gb_before) / self.batch_tokens
        self.values |= {"cost/peak_gb": peak, "cost/peak_bytes_per_token": per_token}
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=trainer.global_step)

    @staticmethod
    def _render_seconds(trainer: lightning.Trainer, module: lightning.LightningModule) -> float:
        """Of a batch of training, taken to be as many scenes of validation."""
        data = trainer.datamodule
        scene = collate([data.evaluation["val"][0]] * data.batch_size)
        inputs, targets = scene["inputs"].to(module.device), scene["targets"].to(module.device)
        was_training = module.net.training
        module.net.eval()  # or the running means of the batch norms would move
        with torch.no_grad():
            gaussians = module.net(inputs)
        module.net.train(was_training)
        return render_seconds(
            gaussians, targets.cameras, module.background, module.loss.needs_depth
        )

    def on_test_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.hooks = [
            module.net.register_forward_pre_hook(lambda *_: self._start(module)),
            module.net.register_forward_hook(
                lambda *_: self.forwards.append(self._elapsed(module))
            ),
        ]

    def on_test_batch_start(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        batch: Any,
        index: int,
        test_set: int = 0,
    ) -> None:
        if index == 0:
            self.forwards = []
            reset_peak_memory(module.device)

    def on_test_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        index: int,
        test_set: int = 0,
    ) -> None:
        """What is known of a test set after each of its scenes; the last one has it all."""
        cost = f"cost/{list(trainer.datamodule.tests)[test_set]}" if test_set else "cost"
        self.values[f"{cost}/inference_seconds"] = statistics.median(self.forwards)
        self.values[f"{cost}/inference_gb"] = peak_memory_gb(module.device)

    def on_test_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        for hook in self.hooks:
            hook.remove()

    def _start(self, module: lightning.LightningModule) -> None:
        wait_for(module.device)
        self.started = time.perf_counter()

    def _elapsed(self, module: lightning.LightningModule) -> float:
        wait_for(module.device)
        return time.perf_counter() - self.started
