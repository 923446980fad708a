"""Measure the costs of a run: parameters, FLOPs, Gaussians, seconds, memory."""

from typing import Any

import lightning
import torch

from asysplat.data.datamodule import collate
from asysplat.evaluation.cost import GB, memory_before_gb
from asysplat.evaluation.measured_cost import CostMeter, mean_but_longest, render_seconds
from asysplat.evaluation.static_cost import static_costs
from asysplat.training.plan import make_plan


class Costs(lightning.Callback):
    """Collects the costs of a run in `values`, "cost/..." -> number.

    Before the first step, it counts the `static_costs` of one scene at the run's views and
    resolution, prints the training's plan (`make_plan`) and refuses a training that does not fit.
    During the run it measures, by `CostMeter`, seconds (mean of all but the longest) and peak
    memory of:

    - a training step: seconds_per_step, peak_gb, and peak_bytes_per_token: the rise of the peak
      over the memory before the first step, for each token of the largest patch in a micro-batch.
    - rendering a step's targets, with gradients: render_seconds_per_step.
    - the network's forward pass over the test scenes: inference_seconds, inference_gb.
    - the rest of the test step, which renders the targets with depth: render_seconds, render_gb.

    The last two are under cost/<set>/ for further test sets. Place this callback before those that
    work at the end of a test step: their work would count as rendering.
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}

    def setup(self, trainer: Any, module: Any, stage: str) -> None:
        """Count costs and plan here, where every process still has all weights."""
        if stage != "fit":
            return
        module.to(trainer.strategy.root_device)
        self.gb_before = memory_before_gb(module.device)
        scene = trainer.datamodule.evaluation["val"][0]["inputs"]
        height, width = scene.images.shape[-2:]
        self.split = trainer.datamodule.split(trainer.world_size)
        self.batch_tokens = self.split.micro_batch * scene.num_views * height * width
        self.batch_tokens //= module.net.patch**2
        costs = static_costs(module.net, scene.num_views, height, width)
        plan = make_plan(trainer, module)
        if trainer.is_global_zero:
            print(plan, flush=True)
        self.values = {f"cost/{name}": value for name, value in costs.items()}

    def on_fit_start(self, trainer: Any, module: Any) -> None:
        self.step = CostMeter(module.device)

    def on_train_start(self, trainer: Any, module: Any) -> None:
        if trainer.global_step == 0:  # a resumed run has logged them
            for logger in trainer.loggers:
                logger.log_metrics(self.values, step=0)

    def on_train_batch_start(self, *_: Any) -> None:
        self.step.start()

    def on_train_batch_end(self, *_: Any) -> None:
        self.step.stop()

    def on_fit_end(self, trainer: Any, module: Any) -> None:
        if self.step.seconds:
            micro_batches = self.split.accumulated
            seconds = {
                "seconds_per_step": mean_but_longest(self.step.seconds),
                "render_seconds_per_step": self._render_seconds(trainer, module),
            }
            self.values |= {f"cost/{name}": micro_batches * s for name, s in seconds.items()}
        if self.step.gb:
            peak = max(self.step.gb)
            per_token = GB * (peak - self.gb_before) / self.batch_tokens
            self.values |= {"cost/peak_gb": peak, "cost/peak_bytes_per_token": per_token}
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=trainer.global_step)

    def _render_seconds(self, trainer: Any, module: Any) -> float:
        """Measure the rendering of a micro-batch, made of copies of a validation scene."""
        scene = collate([trainer.datamodule.evaluation["val"][0]] * self.split.micro_batch)
        inputs, targets = scene["inputs"].to(module.device), scene["targets"].to(module.device)
        was_training = module.net.training
        module.net.eval()  # keeps the running means of batch norms as they are
        with torch.no_grad():
            gaussians = module.net(inputs)
        module.net.train(was_training)
        background = module.background_for({"inputs": inputs, "targets": targets})
        return render_seconds(gaussians, targets.cameras, background, module.loss.needs_depth)

    def on_test_start(self, trainer: Any, module: Any) -> None:
        self.tests = [
            {work: CostMeter(module.device) for work in ("inference", "render")}
            for _ in trainer.datamodule.tests
        ]
        self.hooks = [
            module.net.register_forward_pre_hook(self._predict),
            module.net.register_forward_hook(self._render),
        ]

    def on_test_batch_start(
        self, trainer: Any, module: Any, batch: Any, index: int, set_index: int = 0
    ) -> None:
        self.work = self.tests[set_index]

    def _predict(self, *_: Any) -> None:
        self.work["inference"].start()

    def _render(self, *_: Any) -> None:
        self.work["inference"].stop()
        self.work["render"].start()

    def on_test_batch_end(self, *_: Any) -> None:
        self.work["render"].stop()

    def on_test_end(self, trainer: Any, module: Any) -> None:
        for hook in self.hooks:
            hook.remove()
        for test_set, works in zip(trainer.datamodule.tests, self.tests, strict=True):
            prefix = "cost" if test_set == trainer.datamodule.name else f"cost/{test_set}"
            for name, work in works.items():
                self.values |= work.costs(f"{prefix}/{name}")
