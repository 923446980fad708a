"""A run's checkpoints: the last, to resume from, and the best."""

from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint


class Checkpoints(ModelCheckpoint):
    """Writes the best checkpoint and last.ckpt.

    The best is named and chosen by `filename` and `monitor` in conf/callbacks/default.yaml; without
    a callback that logs what is monitored, it is not written. last.ckpt is written after every
    validation and when training ends.
    """

    @property
    def last(self) -> Path:
        return Path(self.dirpath) / "last.ckpt"

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_train_epoch_end(trainer, module)
        trainer.save_checkpoint(self.last)

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        trainer.save_checkpoint(self.last)

    def on_exception(self, trainer: lightning.Trainer, module: Any, error: BaseException) -> None:
        if isinstance(error, KeyboardInterrupt) and trainer.is_global_zero:
            said = f"to go on, add ckpt_path={self.last} to the same command"
            print(f"stopped; {said if self.last.exists() else 'there is no checkpoint yet'}.")
