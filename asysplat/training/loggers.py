"""What a run says: to its loggers, and on the terminal."""

import logging
import warnings
from collections.abc import Mapping

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from asysplat.errors import plain_warnings
from asysplat.evaluation.metrics import METRICS
from asysplat.runs.runs import CHOICES


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


def log_choices(logger: Logger, config: DictConfig) -> None:
    """Log the options for the hparams tab, which needs the names of its metrics now."""
    choices = {key: OmegaConf.select(config, key) for key in CHOICES}
    if isinstance(logger, TensorBoardLogger):
        logger.log_hyperparams(choices, {f"hp/{name}": 0 for name in METRICS})
    else:
        logger.log_hyperparams(choices)


def log_results(logger: Logger, results: Mapping[str, str | int | float], data: str) -> None:
    """Log the metrics of the test, for the hparams tab."""
    values = {f"hp/{name}": results.get(f"test/{data}/{name}") for name in METRICS}
    logger.log_metrics({name: value for name, value in values.items() if value is not None})
    logger.save()


def quiet_lightning() -> None:
    """Hide Lightning's tips and deprecations; print other warnings without their line of code."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    plain_warnings()
