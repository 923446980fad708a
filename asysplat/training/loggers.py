"""Create the Weights & Biases logger; log figures and histograms."""

from importlib.util import find_spec
from pathlib import Path

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from matplotlib.figure import Figure
from torch import Tensor

from asysplat.errors import InputError


def make_wandb_logger(folder: Path | str, project: str, name: str, offline: bool) -> WandbLogger:
    """Create a logger to Weights & Biases, which needs an account unless it is offline.

    Offline it writes to the folder of the run only, and `wandb sync` uploads it later.

    Raises:
        InputError: wandb is not installed.
    """
    if find_spec("wandb") is None:
        raise InputError(
            "logger=wandb needs wandb: pip install 'asysplat[wandb]', or use logger=tensorboard, "
            "which needs no account."
        )
    return WandbLogger(save_dir=folder, project=project, name=name, offline=offline)


def log_figure(logger: Logger, name: str, figure: Figure, step: int) -> None:
    """Log a figure to TensorBoard or Weights & Biases."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_figure(name, figure, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [figure], step)


def log_histogram(logger: Logger, name: str, values: Tensor, step: int) -> None:
    """Log a histogram of values to TensorBoard or Weights & Biases."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_histogram(name, values, step)
    elif isinstance(logger, WandbLogger):
        import wandb  # an extra

        logger.experiment.log({name: wandb.Histogram(values), "trainer/global_step": step})
