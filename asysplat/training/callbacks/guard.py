"""Skip, count and report steps with non-finite gradients."""

from typing import Any

import lightning
import torch
from torch.optim import Optimizer

from asysplat.errors import InputError


class SkipNonFiniteSteps(lightning.Callback):
    """Drops the gradients of a step in which any is NaN or infinite.

    Args:
        budget: how many skipped steps in a row end the run.

    Raises:
        InputError: the budget is spent; the message names a parameter.
    """

    def __init__(self, budget: int = 10):
        self.budget = budget
        self.skipped, self.in_a_row = 0, 0
        self.scenes: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.skipped, self.in_a_row = state_dict["skipped"], state_dict["in_a_row"]

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, batch: Any, _: int
    ) -> None:
        self.scenes = batch["scene"]

    def on_before_optimizer_step(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, optimizer: Optimizer
    ) -> None:
        named = [(name, p.grad) for name, p in module.named_parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm([grad for _, grad in named])
        module.log("train/grad_norm", norm)
        if norm.isfinite():
            self.in_a_row = 0
            return
        self.skipped += 1
        self.in_a_row += 1
        bad = next((name for name, grad in named if not grad.isfinite().all()), "their sum")
        optimizer.zero_grad(set_to_none=True)
        print(
            f"step {trainer.global_step}: the gradient of {bad} is not finite on "
            f"{', '.join(self.scenes)}; step skipped ({self.skipped} in all)"
        )
        if self.in_a_row >= self.budget:
            raise InputError(
                f"{self.in_a_row} steps in a row had a non-finite gradient (first in {bad}): "
                "lower learning_rate or set trainer.precision=32-true."
            )

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        module.log("train/skipped_steps", float(self.skipped))
