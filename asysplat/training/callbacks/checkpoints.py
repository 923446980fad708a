"""A run's checkpoints: the last two, to resume from, and the best."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from asysplat.training.checkpoints import LAST, PREVIOUS, write_whole
from asysplat.training.random_states import RandomStates, random_states, set_random_states
from asysplat.training.revision import revision
from asysplat.training.tensorboard import event_files

# What a scheduler sends before it kills: SLURM SIGTERM, submitit SIGUSR2, others SIGUSR1.
NOTICES = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


class Checkpoints(ModelCheckpoint):
    """Writes the best checkpoint, last.ckpt, and keeps the one before it as previous.ckpt.

    The best is named and chosen by `filename` and `monitor` in conf/callbacks/default.yaml; without
    a callback that logs what is monitored, it is not written. last.ckpt is written after every
    validation, between them every so many minutes, and when a scheduler gives notice. The run then
    does what it would have done at once: what submitit does, or end with the status 128 + the
    signal's number.

    A checkpoint has, beside what Lightning puts there, `revision`, `random_states` (a list, of each
    process) and `event_files`, see `asysplat.training.tensorboard`.

    Args:
        dirpath: the folder.
        minutes: of training after which last.ckpt is written between validations; 0: after every
            step; None: only after validations.
        options: Lightning's.
    """

    def __init__(self, dirpath: str | Path, minutes: int | float | None = None, **options: Any):
        super().__init__(dirpath=dirpath, **options)
        self.minutes = minutes
        self.notice: int | None = None  # the signal's number
        self.resumed: list[RandomStates] = []
        self.saved_step, self.due = 0, False

    @property
    def last(self) -> Path:
        return Path(self.dirpath) / LAST

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, checkpoint: dict
    ) -> None:
        _begin_at_next_batch(checkpoint["loops"]["fit_loop"])
        states = [random_states()]
        if trainer.world_size > 1:
            states *= trainer.world_size
            torch.distributed.all_gather_object(states, random_states())
        checkpoint["random_states"] = states
        checkpoint["revision"] = revision()
        checkpoint["event_files"] = event_files(trainer.loggers)

    def on_load_checkpoint(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, checkpoint: dict
    ) -> None:
        self.resumed = checkpoint.get("random_states", [])

    def on_fit_start(self, *_: Any) -> None:
        # Before Lightning puts its own in their place, which stop in the middle of a validation.
        self.handlers = {number: signal.getsignal(number) for number in NOTICES}

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        for number, handler in self.handlers.items():
            if handler not in (signal.SIG_IGN, None):
                signal.signal(number, self._take_notice)
        self.saved_step, self.saved_at = trainer.global_step, time.monotonic()
        if len(self.resumed) == trainer.world_size:
            set_random_states(self.resumed[trainer.global_rank])

    def _take_notice(self, number: int, _: Any) -> None:
        self.notice = number

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, _: Any, index: int
    ) -> None:
        """Save here, where the step before is complete, its validation and its log too."""
        if index % trainer.accumulate_grad_batches:
            return
        waited = time.monotonic() - self.saved_at
        if (self.minutes is not None and waited >= 60 * self.minutes) or self.notice is not None:
            self.due = True
        if trainer.strategy.reduce_boolean_decision(self.due, all=False):
            self._save_last(trainer)
        self._heed(trainer)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_train_epoch_end(trainer, module)
        self.due = True

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self._save_last(trainer)

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        # What follows is logged at this step, which Lightning has one lower where it went on from
        # the end of a training: see `_begin_at_next_batch`.
        trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step

    def _save_last(self, trainer: lightning.Trainer) -> None:
        if trainer.global_step == self.saved_step:
            return
        fresh = self.last.with_name("next.ckpt")
        trainer.save_checkpoint(fresh)
        if trainer.is_global_zero:
            if self.last.exists():
                os.replace(self.last, self.last.with_name(PREVIOUS))
            os.replace(fresh, self.last)
        self.saved_step, self.saved_at, self.due = trainer.global_step, time.monotonic(), False

    def _heed(self, trainer: lightning.Trainer) -> None:
        """Do what the scheduler's notice would have done, now that there is a checkpoint."""
        if not trainer.strategy.reduce_boolean_decision(self.notice is not None, all=False):
            return
        number, self.notice = self.notice or signal.SIGTERM, None
        if trainer.is_global_zero:
            name = signal.Signals(number).name
            print(f"{name}: saved at step {trainer.global_step}", flush=True)
        handler = self.handlers[number]
        if callable(handler):
            handler(number, None)
        else:
            raise SystemExit(128 + number)

    def on_exception(self, trainer: lightning.Trainer, module: Any, error: BaseException) -> None:
        if trainer.is_global_zero:
            said = f"to go on, add ckpt_path={self.last} to the same command"
            print(f"stopped; {said if self.last.exists() else 'there is no checkpoint yet'}.")


def _begin_at_next_batch(loop: dict[str, Any]) -> None:
    """Let a saved training loop go on with the batch after the last that was trained on.

    Lightning would end an epoch once more that had ended, or count a batch that was only fetched.

    Args:
        loop: the state of the loop of epochs, changed in place.
    """
    epoch, batch = loop["epoch_progress"], loop["epoch_loop.batch_progress"]
    if epoch["current"]["ready"] == epoch["current"]["processed"]:  # between two epochs
        for count in (epoch["total"], epoch["current"]):
            count["completed"] = count["processed"]
            count["ready"] = count["started"] = count["processed"] + 1
        batch["current"] = dict.fromkeys(batch["current"], 0)
        batch["total"]["ready"] += 1
    batch["is_last_batch"] = False
    loop["epoch_loop.state_dict"]["_batches_that_stepped"] -= 1  # it adds 1 when it goes on


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints that are there whole or not at all.

    Raises:
        InputError: there is no room, or one may not write there.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(checkpoint, Path(path))
