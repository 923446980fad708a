"""Count and report what a training skips: non-finite steps, and scenes that cannot be read."""

from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim import Optimizer

from asysplat.errors import InputError, list_names
from asysplat.training.parallel import Batch


class NonFiniteSteps(Callback):
    """Drops a step with a non-finite gradient and undoes it; ends a run at `budget` in a row."""

    def __init__(self, budget: int = 10):
        self.budget = budget
        self.count, self.in_a_row = 0, 0
        self.scenes: list[str] = []  # names in the step's micro-batches
        self.buffers: list[Tensor] = []  # copies from before the step

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.count, self.in_a_row = state_dict["count"], state_dict["in_a_row"]

    def on_train_batch_start(
        self, trainer: Trainer, module: LightningModule, batch: Batch, index: int
    ) -> None:
        if index % trainer.accumulate_grad_batches == 0:
            self.scenes = []
            self.buffers = [buffer.clone() for buffer in module.buffers()]
        self.scenes += batch["scene"]

    def on_before_optimizer_step(
        self, trainer: Trainer, module: LightningModule, optimizer: Optimizer
    ) -> None:
        grads = {name: p.grad for name, p in module.named_parameters() if p.grad is not None}
        norm = torch.nn.utils.get_total_norm(list(grads.values()))
        module.log("train/grad_norm", norm)
        if trainer.strategy.reduce_boolean_decision(bool(norm.isfinite())):
            self.in_a_row = 0
            return
        self.count += 1
        self.in_a_row += 1
        bad = [name for name, grad in grads.items() if not grad.isfinite().all()]
        bad = list_names(bad) or "all parameters together"
        optimizer.zero_grad(set_to_none=True)
        for buffer, before in zip(module.buffers(), self.buffers, strict=True):
            buffer.copy_(before)
        print(
            f"step {trainer.global_step}: the gradient of {bad} is not finite on "
            f"{', '.join(self.scenes)}; the step is dropped ({self.count} in all)",
            flush=True,
        )
        if self.in_a_row >= self.budget:
            raise InputError(
                f"{self.in_a_row} steps in a row had a non-finite gradient (last: that of {bad}): "
                "lower learning_rate or set trainer.precision=32-true."
            )

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        module.log("train/non_finite_steps", float(self.count))


class BadScenes(Callback):
    """Counts and names the training scenes that data.on_error=skip has replaced by others."""

    def __init__(self):
        self.count = 0
        self.errors: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "errors": self.errors}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.count, self.errors = state_dict["count"], list(state_dict["errors"])

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, _: object, batch: Batch, index: int
    ) -> None:
        self.count += len(batch["bad_scenes"])
        self.errors += [e for e in dict.fromkeys(batch["bad_scenes"]) if e not in self.errors]

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        module.log("train/bad_scenes", float(self.count), sync_dist=True, reduce_fx="sum")

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        if self.count:
            print(f"{self.count} training scenes were replaced: {list_names(self.errors)}")
