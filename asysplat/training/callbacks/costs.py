"""What a run costs: parameters, FLOPs, Gaussians, seconds, memory."""

from typing import Any

import lightning
import torch

from asysplat.data.datamodule import collate
from asysplat.evaluation.cost import GB, peak_memory_gb, reset_peak_memory
from asysplat.evaluation.measured import Measured, mean_but_longest
from asysplat.evaluation.render_time import render_seconds
from asysplat.evaluation.static_cost import static_costs


class Costs(lightning.Callback):
    """Writes `values`, "cost/..." -> number; what needs no running is known before the first step.

    Of one scene at the run's views and resolution: see `static_costs`. Measured, as `Measured` does
    it, seconds in the mean of all but the longest and memory at its peak:

    - a training step: seconds_per_step, peak_gb; what the peak is beyond what there was before the
      first step, for each token of the largest patch in a batch: peak_bytes_per_token; what a step
      renders, with its gradients: render_seconds_per_step.
    - the network's forward pass alone, over the test's scenes: inference_seconds, inference_gb; the
      rest of their test step, which renders the targets with depth: render_seconds, render_gb. Of
      a further test set they stand under its name: cost/<set>/inference_seconds.

    Comes before callbacks that work when a test step has ended, or that would count as rendering.
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}

    def on_fit_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.step = Measured(module.device)
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

    def on_train_batch_start(self, *_: Any) -> None:
        self.step.start()

    def on_train_batch_end(self, *_: Any) -> None:
        self.step.stop()

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        if self.step.seconds:
            self.values["cost/seconds_per_step"] = mean_but_longest(self.step.seconds)
            self.values["cost/render_seconds_per_step"] = self._render_seconds(trainer, module)
        if self.step.gb:
            peak = max(self.step.gb)
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
        self.tests = [
            {work: Measured(module.device) for work in ("inference", "render")}
            for _ in trainer.datamodule.tests
        ]
        self.hooks = [
            module.net.register_forward_pre_hook(self._predict),
            module.net.register_forward_hook(self._render),
        ]

    def on_test_batch_start(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        self.work = self.tests[dataloader_idx]

    def _predict(self, *_: Any) -> None:
        self.work["inference"].start()

    def _render(self, *_: Any) -> None:
        self.work["inference"].stop()
        self.work["render"].start()

    def on_test_batch_end(self, *_: Any) -> None:
        self.work["render"].stop()

    def on_test_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        for hook in self.hooks:
            hook.remove()
        for test_set, works in zip(trainer.datamodule.tests, self.tests, strict=True):
            prefix = "cost" if test_set == trainer.datamodule.name else f"cost/{test_set}"
            for name, work in works.items():
                self.values |= work.costs(f"{prefix}/{name}")
