"""Show the progress of a run: Lightning's bar on a terminal, a line now and then elsewhere."""

import sys
import time
from datetime import timedelta
from multiprocessing import current_process

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.utilities import rank_zero_only

LINE_SECONDS = 60  # from a line to the next, at least, unless a validation is between


def show_progress() -> Callback:
    """Return a bar, or `ProgressLines` without a terminal of one's own."""
    alone = current_process().name == "MainProcess"  # bars of jobs side by side overwrite another
    return StepsBar() if alone and sys.stdout.isatty() else ProgressLines()


class StepsBar(RichProgressBar):
    """Lightning's bar, from a validation to the next, with the step of the whole training."""

    def _get_train_description(self, current_epoch: int) -> str:
        return f"from step {self.trainer.global_step} of {self.trainer.max_steps}"


class ProgressLines(Callback):
    """Prints steps, the time that is left and the PSNR after each validation, and each minute."""

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        self.first, self.started = trainer.global_step, time.monotonic()
        self.printed = self.started

    def on_train_batch_end(self, trainer: Trainer, *_: object) -> None:
        if time.monotonic() - self.printed > LINE_SECONDS:
            self._print(trainer)

    def on_validation_end(self, trainer: Trainer, module: LightningModule) -> None:
        if not trainer.sanity_checking and trainer.global_step > self.first:
            self._print(trainer)

    @rank_zero_only
    def _print(self, trainer: Trainer) -> None:
        step, self.printed = trainer.global_step, time.monotonic()
        each = (self.printed - self.started) / max(1, step - self.first)
        left = timedelta(seconds=round(each * (trainer.max_steps - step)))
        values = trainer.callback_metrics
        names = {"train/psnr": "PSNR {:.1f}", "val/psnr": "validation {:.1f}"}
        quality = [text.format(values[name]) for name, text in names.items() if name in values]
        line = f"step {step} of {trainer.max_steps}, {left} left: {', '.join(quality)}"
        print(line.removesuffix(": "), flush=True)
