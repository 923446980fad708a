"""Name and count the scenes that cannot be read, where others are drawn in their place."""

from typing import Any

import lightning

from asysplat.errors import InputError


class BadScenes(lightning.Callback):
    """Prints each trouble with a training scene once; logs how many tasks were drawn anew.

    It is for data.on_bad_scene=skip.

    Args:
        budget: how many different troubles a process puts up with.

    Raises:
        InputError: there are more.
    """

    def __init__(self, budget: int = 10):
        self.budget = budget
        self.skipped = 0
        self.troubles: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        return {"skipped": self.skipped, "troubles": self.troubles}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.skipped, self.troubles = state_dict["skipped"], list(state_dict["troubles"])

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        index: int,
    ) -> None:
        self.skipped += len(batch["skipped"])
        for trouble in dict.fromkeys(batch["skipped"]):
            if trouble not in self.troubles:
                self.troubles.append(trouble)
                print(f"step {trainer.global_step}: another scene in place of one: {trouble}")
        if len(self.troubles) > self.budget:
            listed = "".join(f"\n  {trouble}" for trouble in self.troubles)
            raise InputError(
                f"more than {self.budget} training scenes cannot be used: fix them or take them "
                f"out of data.root, or raise callbacks.bad_scenes.budget:{listed}"
            )

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        skipped = float(self.skipped)
        module.log("train/skipped_scenes", skipped, sync_dist=True, reduce_fx="sum")
