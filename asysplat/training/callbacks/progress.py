"""The progress of a run: bars on a terminal, elsewhere a line now and then."""

import time
from datetime import timedelta
from multiprocessing import current_process
from typing import Any

import lightning
from lightning.pytorch.callbacks import ProgressBar
from rich import progress
from rich.console import Console

REFRESH_SECONDS = 0.2
SPEED_SECONDS = 3600  # of training, from which the time left is estimated
LINE_SECONDS, LINE_SHARE = 60, 0.01  # least time and share of the steps between two lines


class TrainingProgressBar(ProgressBar):
    """Shows the steps of the whole training with their PSNR; bars for validation and test.

    Without a terminal, or when several runs share one, it prints a line after each validation, and
    between two validations at most one each minute and each hundredth of the training.
    """

    def __init__(self):
        super().__init__()
        self.shown = True
        self.bars: progress.Progress | None = None

    def disable(self) -> None:
        self.shown = False

    def enable(self) -> None:
        self.shown = True

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self._open()
        step = trainer.global_step
        self.training = self._add("training", total=trainer.max_steps, completed=step)
        self._draw(trainer, at_once=True)
        self.told, self.told_at = step, time.monotonic()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        step, total = trainer.global_step, trainer.max_steps
        self.bars.update(self.training, completed=step)
        self._draw(trainer)
        waited = time.monotonic() - self.told_at
        if waited > LINE_SECONDS and step - self.told >= LINE_SHARE * total:
            self._tell(trainer)

    def on_validation_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.validation = self._add("validation", total=sum(trainer.num_val_batches))

    def on_validation_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        self.bars.advance(self.validation)
        self._draw(trainer)

    def on_validation_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.bars.remove_task(self.validation)
        self._tell(trainer)

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self._close(trainer)

    def on_test_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self._open()
        self.testing = self._add("test", total=sum(trainer.num_test_batches))
        self._draw(trainer, at_once=True)

    def on_test_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        self.bars.advance(self.testing)
        self._draw(trainer)

    def on_test_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self._close(trainer)

    def on_exception(self, trainer: lightning.Trainer, *_: Any) -> None:
        if self.bars is not None:
            self._close(trainer)

    def _open(self) -> None:
        console = Console()
        # Runs side by side would draw over each other.
        self.on_terminal = console.is_terminal and current_process().name == "MainProcess"
        self.bars = progress.Progress(
            progress.TextColumn("{task.description:10}"),
            progress.BarColumn(bar_width=10),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            progress.TextColumn("left  {task.fields[quality]}"),
            console=console,
            auto_refresh=False,  # a thread that draws would break in the loaders' forks
            speed_estimate_period=SPEED_SECONDS,
            disable=not (self.shown and self.on_terminal),
        )
        self.bars.start()
        self.drawn_at = time.monotonic()

    def _close(self, trainer: lightning.Trainer) -> None:
        self._draw(trainer, at_once=True)
        self.bars.stop()

    def _add(self, name: str, **counts: int) -> progress.TaskID:
        return self.bars.add_task(name, quality="", **counts)

    def _draw(self, trainer: lightning.Trainer, at_once: bool = False) -> None:
        if self.bars.disable or not (at_once or self._due()):
            return
        for task in self.bars.tasks:
            if task.description == "training":
                self.bars.update(task.id, quality=quality(trainer))
        self.bars.refresh()
        self.drawn_at = time.monotonic()

    def _due(self) -> bool:
        return time.monotonic() - self.drawn_at > REFRESH_SECONDS

    def _tell(self, trainer: lightning.Trainer) -> None:
        if not self.shown or self.on_terminal:
            return
        self.told, self.told_at = trainer.global_step, time.monotonic()
        seconds = self.bars.tasks[0].time_remaining
        left = "" if seconds is None else f", {timedelta(seconds=round(seconds))} left"
        told = f"step {self.told} of {trainer.max_steps}{left}: {quality(trainer)}"
        print(told.removesuffix(": "), flush=True)


def quality(trainer: lightning.Trainer) -> str:
    """Format the PSNR in dB of the last step and of the last validation, as far as measured."""
    found = trainer.callback_metrics
    names = {"train/psnr": "PSNR {:.1f}", "val/psnr": "validation {:.1f}"}
    return ", ".join(text.format(found[name]) for name, text in names.items() if name in found)
