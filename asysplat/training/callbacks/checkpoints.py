"""Write a run's checkpoints: the last two, to resume from, and the best."""

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from asysplat.runs.checkpoints import LAST, PREVIOUS, atomic_save
from asysplat.runs.machine import revision
from asysplat.runs.summary import Results

RandomStates = dict[str, Any]  # tensors and plain values: a checkpoint is read with weights_only


def random_states() -> RandomStates:
    """Return the states of Python's, NumPy's and torch's generators, of all GPUs too."""
    name, keys, *rest = np.random.get_state()
    return {
        "python": random.getstate(),
        "numpy": (name, torch.from_numpy(keys.astype(np.int64)), *rest),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all(),
    }


def set_random_states(states: RandomStates) -> None:
    """Restore the generators; those of GPUs only if their number is the same."""
    random.setstate(states["python"])
    name, keys, *rest = states["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), *rest))
    torch.set_rng_state(states["torch"])
    if len(states["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(states["cuda"])


# A scheduler sends one before it kills: SLURM SIGTERM, submitit SIGUSR2, others SIGUSR1.
PREEMPTION_SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


class Checkpoints(ModelCheckpoint):
    """Writes the best checkpoint and last.ckpt; renames the previous last.ckpt to previous.ckpt.

    `filename` and `monitor` name and select the best; it is not written if no callback logs
    `monitor`. last.ckpt is written after every validation, every `minutes` between validations, and
    at one of PREEMPTION_SIGNALS; then the signal's earlier handler runs (submitit's, for example),
    or the run ends with status 128 + the signal's number.

    Beside Lightning's entries, a checkpoint holds `revision` and each process's `random_states`.
    `minutes` of 0 stand for every step; without them last.ckpt is only written after validations.
    """

    def __init__(self, dirpath: str | Path, minutes: int | float | None = None, **options: Any):
        super().__init__(dirpath=dirpath, **options)
        self.minutes = minutes
        self.preempted_by: int | None = None  # the signal's number
        self.loaded_states: list[RandomStates] = []
        self.saved_step, self.save_due = 0, False

    @property
    def last(self) -> Path:
        return Path(self.dirpath) / LAST

    def on_save_checkpoint(
        self, trainer: Trainer, module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        _begin_at_next_batch(checkpoint["loops"]["fit_loop"])
        states = [random_states()]
        if trainer.world_size > 1:
            states *= trainer.world_size
            torch.distributed.all_gather_object(states, random_states())
        checkpoint["random_states"] = states
        checkpoint["revision"] = revision()

    def on_load_checkpoint(
        self, trainer: Trainer, module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        self.loaded_states = checkpoint.get("random_states", [])

    def on_fit_start(self, *_: object) -> None:
        # Before Lightning sets its own handlers, which stop in the middle of a validation.
        self.handlers = {number: signal.getsignal(number) for number in PREEMPTION_SIGNALS}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        for number, handler in self.handlers.items():
            if handler not in (signal.SIG_IGN, None):
                signal.signal(number, self._on_preemption)
        self.saved_step, self.saved_at = trainer.global_step, time.monotonic()
        if len(self.loaded_states) == trainer.world_size:
            set_random_states(self.loaded_states[trainer.global_rank])

    def _on_preemption(self, number: int, _: object) -> None:
        self.preempted_by = number

    def on_train_batch_start(
        self, trainer: Trainer, module: LightningModule, _: object, index: int
    ) -> None:
        """Save here, where the previous step, its validation and its log are complete."""
        if index % trainer.accumulate_grad_batches:
            return
        waited = time.monotonic() - self.saved_at
        elapsed = self.minutes is not None and waited >= 60 * self.minutes
        self.save_due |= elapsed or self.preempted_by is not None
        if trainer.strategy.reduce_boolean_decision(self.save_due, all=False):
            self._save_last(trainer)
        self._forward_preemption(trainer)

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_train_epoch_end(trainer, module)
        self.save_due = True

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        self._save_last(trainer)

    def on_fit_end(self, trainer: Trainer, module: LightningModule) -> None:
        # The test is logged at this step. Lightning's count is one lower if it resumed from the
        # end of a training: see `_begin_at_next_batch`.
        trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step

    def _save_last(self, trainer: Trainer) -> None:
        if trainer.global_step == self.saved_step:
            return
        fresh = self.last.with_name("next.ckpt")
        trainer.save_checkpoint(fresh)
        if trainer.is_global_zero:
            if self.last.exists():
                os.replace(self.last, self.last.with_name(PREVIOUS))
            os.replace(fresh, self.last)
        self.saved_step, self.saved_at, self.save_due = trainer.global_step, time.monotonic(), False

    def _forward_preemption(self, trainer: Trainer) -> None:
        """Run the handler of the scheduler's signal, now that there is a checkpoint."""
        if not trainer.strategy.reduce_boolean_decision(self.preempted_by is not None, all=False):
            return
        number, self.preempted_by = self.preempted_by or signal.SIGTERM, None
        if trainer.is_global_zero:
            name = signal.Signals(number).name
            print(f"{name}: saved at step {trainer.global_step}", flush=True)
        if not callable(self.handlers[number]):
            raise SystemExit(128 + number)
        self.handlers[number](number, None)

    def on_exception(self, trainer: Trainer, module: LightningModule, error: BaseException) -> None:
        if not trainer.is_global_zero:
            return
        if HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
            print("stopped.")  # a sweep has no option for the checkpoint of a single job
            return
        resume = f"to go on, add ckpt_path={self.last} to the same command"
        print(f"stopped; {resume if self.last.exists() else 'there is no checkpoint yet'}.")


def _begin_at_next_batch(loop: dict[str, Any]) -> None:
    """Change the state of a training loop so that it resumes with the next untrained batch.

    Lightning would end a completed epoch again, or count a batch that was only fetched.
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
    """Writes checkpoints atomically."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        atomic_save(checkpoint, Path(path))


class StageRecord(Callback):
    """Saves the name of the stage and the results of the stages before it in each checkpoint."""

    def __init__(self, stage: str, earlier: Results):
        self.stage, self.earlier = stage, earlier

    def state_dict(self) -> dict[str, Any]:
        return {"stage": self.stage, "earlier": self.earlier}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        if self.earlier and trainer.global_step == 0:
            trainer.save_checkpoint(trainer.checkpoint_callback.last)
