"""Show the progress of a run: bars on a terminal, a line now and then elsewhere."""

import time
from datetime import timedelta
from multiprocessing import current_process

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich import progress

from asysplat.terminal import make_console

REFRESH_SECONDS = 0.2
SPEED_SECONDS = 3600  # period of training from which the remaining time is estimated
LINE_SECONDS, LINE_FRACTION = 60, 0.01  # least time and fraction of steps from a line to the next


class TrainingProgressBar(ProgressBar):
    """Shows the steps of the whole training with their PSNR; bars for validation and test.

    Without a terminal, or when several runs share one, it prints a line after each validation, and
    between two validations at most one line per minute and per hundredth of the training.
    """

    def __init__(self):
        super().__init__()
        self.enabled = True
        self.bars: progress.Progress | None = None

    def disable(self) -> None:
        self.enabled = False

    def on_fit_start(self, trainer: Trainer, module: LightningModule) -> None:
        self._open()  # a validation may precede the training
        self.training = self._add("training", total=trainer.max_steps)

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        step = trainer.global_step
        self.bars.reset(self.training, completed=step)
        self._draw(trainer, force=True)
        self.printed_step, self.printed_at = step, time.monotonic()

    def on_train_batch_end(self, trainer: Trainer, module: LightningModule, *_: object) -> None:
        step, total = trainer.global_step, trainer.max_steps
        self.bars.update(self.training, completed=step)
        self._draw(trainer)
        waited = time.monotonic() - self.printed_at
        if waited > LINE_SECONDS and step - self.printed_step >= LINE_FRACTION * total:
            self._print_line(trainer)

    def on_validation_start(self, trainer: Trainer, module: LightningModule) -> None:
        self.validation = self._add("validation", total=sum(trainer.num_val_batches))

    def on_validation_batch_end(
        self, trainer: Trainer, module: LightningModule, *_: object
    ) -> None:
        self.bars.advance(self.validation)
        self._draw(trainer)

    def on_validation_end(self, trainer: Trainer, module: LightningModule) -> None:
        self.bars.remove_task(self.validation)
        self._print_line(trainer)

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        self._close(trainer)

    def on_test_start(self, trainer: Trainer, module: LightningModule) -> None:
        self._open()
        self.testing = self._add("test", total=sum(trainer.num_test_batches))
        self._draw(trainer, force=True)

    def on_test_batch_end(self, trainer: Trainer, module: LightningModule, *_: object) -> None:
        self.bars.advance(self.testing)
        self._draw(trainer)

    def on_test_end(self, trainer: Trainer, module: LightningModule) -> None:
        self._close(trainer)

    def on_exception(self, trainer: Trainer, *_: object) -> None:
        if self.bars is not None:
            self._close(trainer)

    def _open(self) -> None:
        console = make_console()
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
            auto_refresh=False,  # a drawing thread would break in the forked data loaders
            speed_estimate_period=SPEED_SECONDS,
            disable=not (self.enabled and self.on_terminal),
        )
        self.bars.start()
        self.drawn_at = time.monotonic()

    def _close(self, trainer: Trainer) -> None:
        self._draw(trainer, force=True)
        self.bars.stop()

    def _add(self, name: str, **counts: int) -> progress.TaskID:
        return self.bars.add_task(name, quality="", **counts)

    def _draw(self, trainer: Trainer, force: bool = False) -> None:
        due = force or time.monotonic() - self.drawn_at > REFRESH_SECONDS
        if self.bars.disable or not due:
            return
        for task in self.bars.tasks:
            if task.description == "training":
                self.bars.update(task.id, quality=quality(trainer))
        self.bars.refresh()
        self.drawn_at = time.monotonic()

    def _print_line(self, trainer: Trainer) -> None:
        if not self.enabled or self.on_terminal:
            return
        self.printed_step, self.printed_at = trainer.global_step, time.monotonic()
        seconds = self.bars.tasks[0].time_remaining
        remaining = "" if seconds is None else f", {timedelta(seconds=round(seconds))} left"
        line = f"step {self.printed_step} of {trainer.max_steps}{remaining}: {quality(trainer)}"
        print(line.removesuffix(": "), flush=True)


def quality(trainer: Trainer) -> str:
    """Format the PSNR in dB of the last step and the last validation, where they are measured."""
    values = trainer.callback_metrics
    names = {"train/psnr": "PSNR {:.1f}", "val/psnr": "validation {:.1f}"}
    return ", ".join(text.format(values[name]) for name, text in names.items() if name in values)
