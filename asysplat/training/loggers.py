"""What a run says: to its loggers, and on the terminal."""

import logging
import sys
import time
import warnings
from collections.abc import Collection, Mapping
from datetime import timedelta
from multiprocessing import current_process

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from asysplat.errors import plain_warnings
from asysplat.evaluation.metrics import METRICS
from asysplat.runs.runs import CHOICES


def log_numbers(trainer: Trainer, numbers: Mapping[str, float | int], step: int) -> None:
    """Log numbers at once, whatever `log_every_n_steps` is."""
    for logger in trainer.loggers:
        logger.log_metrics(numbers, step=step)


def log_figure(logger: Logger, name: str, figure: Figure, step: int) -> None:
    """Log a figure to TensorBoard or Weights & Biases."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_figure(name, figure, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [figure], step)


def log_histogram(logger: Logger, name: str, values: Tensor, step: int) -> None:
    """Log a histogram of values to TensorBoard; other loggers get none."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_histogram(name, values, step)


def log_charts(logger: Logger, metrics: Collection[str]) -> None:
    """Log which curves share a chart of TensorBoard: PSNR of training and validation, above all."""
    if isinstance(logger, TensorBoardLogger):
        charts = {METRICS[name]: [f"val/{name}"] for name in METRICS if name in metrics}
        charts[METRICS["psnr"]].append("train/psnr")
        charts["loss"] = ["train/loss"]
        charts = {title: ["Multiline", tags] for title, tags in charts.items()}
        logger.experiment.add_custom_scalars({"training": charts})


def log_choices(logger: Logger, config: DictConfig) -> None:
    """Log the options that tell a run from others."""
    logger.log_hyperparams({key: OmegaConf.select(config, key) for key in CHOICES})


def log_results(logger: Logger, results: Mapping[str, str | int | float], data: str) -> None:
    """Log the metrics that the test measured, and no others, for the hparams tab."""
    keys = {f"hp/{name}": f"test/{data}/{name}" for name in METRICS}
    values = {name: results[key] for name, key in keys.items() if key in results}
    if isinstance(logger, TensorBoardLogger):  # not earlier: the first list of metrics stays
        logger.log_hyperparams(logger.hparams, values)
    else:
        logger.log_metrics(values)
    logger.save()


def quiet_lightning() -> None:
    """Hide Lightning's tips and deprecations; print other warnings without their line of code."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    plain_warnings()


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
