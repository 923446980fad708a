"""Report and count training scenes that cannot be read and were replaced by others."""

from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.types import STEP_OUTPUT

from asysplat.errors import InputError
from asysplat.training.parallel import Batch


class BadScenes(Callback):
    """Prints each error of a training scene once; logs how many scenes were replaced.

    Used with data.on_bad_scene=skip.

    Args:
        budget: how many different errors a process accepts.
    """

    def __init__(self, budget: int = 10):
        self.budget = budget
        self.count = 0
        self.errors: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "errors": self.errors}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.count, self.errors = state_dict["count"], list(state_dict["errors"])

    def on_train_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: STEP_OUTPUT,
        batch: Batch,
        index: int,
    ) -> None:
        self.count += len(batch["bad_scenes"])
        for error in dict.fromkeys(batch["bad_scenes"]):
            if error not in self.errors:
                self.errors.append(error)
                print(f"step {trainer.global_step}: a bad scene is replaced by another: {error}")
        if len(self.errors) > self.budget:
            listed = "".join(f"\n  {error}" for error in self.errors)
            raise InputError(
                f"more than {self.budget} training scenes cannot be used: fix them or take them "
                f"out of data.root, or raise callbacks.bad_scenes.budget:{listed}"
            )

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        module.log("train/bad_scenes", float(self.count), sync_dist=True, reduce_fx="sum")
