"""Skip, count and report steps with non-finite gradients."""

from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.optim import Optimizer

from asysplat.errors import InputError
from asysplat.training.non_finite import first_non_finite, save_step
from asysplat.training.random_states import RandomStates, random_states, set_random_states
from asysplat.training.side_by_side import split

FILES = 3  # of a run: each has the weights of the model


class NonFiniteSteps(lightning.Callback):
    """Drops the gradients of a step in which any is NaN or infinite, and what it did to buffers.

    Then the step is taken once more, scene by scene, to name the scene and the first tensor that is
    not finite. The first FILES of a run are kept in its folder `non_finite`; python -m
    asysplat.training.non_finite takes them again.

    Args:
        folder: of the run.
        budget: how many skipped steps in a row end the run.

    Raises:
        InputError: the budget is spent; the message names a tensor.
    """

    def __init__(self, folder: str | Path, budget: int = 10):
        self.folder, self.budget = Path(folder) / "non_finite", budget
        self.skipped, self.in_a_row = 0, 0
        self.batches: list[tuple[dict[str, Any], RandomStates]] = []  # of the step at hand
        self.buffers: list[Tensor] = []  # before the step

    def state_dict(self) -> dict[str, Any]:
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.skipped, self.in_a_row = state_dict["skipped"], state_dict["in_a_row"]

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, batch: Any, index: int
    ) -> None:
        if index % trainer.accumulate_grad_batches == 0:
            self.batches = []
            self.buffers = [buffer.clone() for buffer in module.buffers()]
        self.batches.append((batch, random_states()))

    def on_before_optimizer_step(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, optimizer: Optimizer
    ) -> None:
        named = [(name, p.grad) for name, p in module.named_parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm([grad for _, grad in named])
        module.log("train/grad_norm", norm)
        if trainer.strategy.reduce_boolean_decision(bool(norm.isfinite())):
            self.in_a_row = 0
            return
        self.skipped += 1
        self.in_a_row += 1
        bad = [f"the gradient of {name}" for name, grad in named if not grad.isfinite().all()]
        optimizer.zero_grad(set_to_none=True)
        for buffer, before in zip(module.buffers(), self.buffers, strict=True):
            buffer.copy_(before)
        first, scenes, how = self._find(trainer, module) or (
            bad[0] if bad else "the sum of all gradients",
            [scene for batch, _ in self.batches for scene in batch["scene"]],
            "",
        )
        print(
            f"step {trainer.global_step}: {first} is not finite on {', '.join(scenes)}; "
            f"step skipped ({self.skipped} in all){how}",
            flush=True,
        )
        if self.in_a_row >= self.budget:
            raise InputError(
                f"{self.in_a_row} steps in a row had a non-finite gradient (last: {first}): "
                "lower learning_rate or set trainer.precision=32-true."
            )

    def _find(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> tuple[str, list[str], str] | None:
        """Return the tensor, the scene and how to see it again; None where all is finite now."""
        now = random_states()
        try:
            for batch, states in self.batches:
                set_random_states(states)
                for scene in split(batch):
                    with trainer.precision_plugin.forward_context():
                        first = first_non_finite(module, scene)
                    if first is not None:
                        return first, scene["scene"], self._keep(trainer, module, scene, states)
        finally:
            set_random_states(now)
        return None

    def _keep(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        scene: dict[str, Any],
        states: RandomStates,
    ) -> str:
        if self.skipped > FILES:
            return ""
        path = self.folder / f"step-{trainer.global_step:06d}-{trainer.global_rank}.pt"
        save_step(path, module, scene, states)
        return f"\n  to see it again: python -m asysplat.training.non_finite {path}"

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        module.log("train/skipped_steps", float(self.skipped))
