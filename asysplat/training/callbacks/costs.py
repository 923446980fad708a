"""Measure the costs of a run: parameters, FLOPs, Gaussians, seconds, memory."""

from typing import Any

import lightning

from asysplat.evaluation.measured_cost import CostMeter, mean_but_longest
from asysplat.evaluation.static_cost import static_costs
from asysplat.training.plan import make_plan


class Costs(lightning.Callback):
    """Collects the costs of a run in `values`, "cost/..." -> number.

    Before the first step, it counts the `static_costs` of one scene at the run's views and
    resolution, prints the training's plan (`make_plan`) and refuses a training that does not fit.
    During the run it measures, by `CostMeter`, seconds (mean of all but the longest) and peak
    memory of a training step (seconds_per_step, peak_gb) and of the network's forward pass over
    the test scenes (inference_seconds, inference_gb; under cost/<set>/ for further test sets).
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}

    def setup(self, trainer: Any, module: Any, stage: str) -> None:
        """Count costs and plan here, where every process still has all weights."""
        if stage != "fit":
            return
        module.to(trainer.strategy.root_device)
        scene = trainer.datamodule.evaluation["val"][0]["inputs"]
        costs = static_costs(module.net, scene.num_views, *scene.images.shape[-2:])
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
            seconds = trainer.accumulate_grad_batches * mean_but_longest(self.step.seconds)
            self.values["cost/seconds_per_step"] = seconds
        if self.step.gb:
            self.values["cost/peak_gb"] = max(self.step.gb)
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=trainer.global_step)

    def on_test_start(self, trainer: Any, module: Any) -> None:
        self.tests = [CostMeter(module.device) for _ in trainer.datamodule.tests]
        self.hooks = [
            module.net.register_forward_pre_hook(lambda *_: self.inference.start()),
            module.net.register_forward_hook(lambda *_: self.inference.stop()),
        ]

    def on_test_batch_start(
        self, trainer: Any, module: Any, batch: Any, index: int, set_index: int = 0
    ) -> None:
        self.inference = self.tests[set_index]

    def on_test_end(self, trainer: Any, module: Any) -> None:
        for hook in self.hooks:
            hook.remove()
        for test_set, meter in zip(trainer.datamodule.tests, self.tests, strict=True):
            prefix = "cost" if test_set == trainer.datamodule.name else f"cost/{test_set}"
            if meter.seconds:
                self.values[f"{prefix}/inference_seconds"] = mean_but_longest(meter.seconds)
            if meter.gb:
                self.values[f"{prefix}/inference_gb"] = max(meter.gb)
