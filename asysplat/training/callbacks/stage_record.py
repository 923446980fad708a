"""Save which stage of a run a checkpoint is of."""

from typing import Any

from lightning import Callback, LightningModule, Trainer

from asysplat.runs.summary import Results


class StageRecord(Callback):
    """Saves the name of the stage and the results of the stages before it in each checkpoint.

    A later stage writes its first checkpoint before its first step, which saves the results of the
    stage before it.
    """

    def __init__(self, stage: str, earlier: Results):
        self.stage, self.earlier = stage, earlier

    def state_dict(self) -> dict[str, Any]:
        return {"stage": self.stage, "earlier": self.earlier}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        if self.earlier and trainer.global_step == 0:
            trainer.save_checkpoint(trainer.checkpoint_callback.last)
