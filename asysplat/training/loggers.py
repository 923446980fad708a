"""Create the Weights & Biases logger; log figures and histograms."""

from importlib.util import find_spec
from pathlib import Path

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from matplotlib.figure import Figure

from asysplat.errors import InputError
from asysplat.training.histogram import Histogram


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


def log_histogram(logger: Logger, name: str, histogram: Histogram, step: int) -> None:
    """Log a histogram to TensorBoard or Weights & Biases."""
    edges, counts = histogram.edges, histogram.counts.cpu()
    middles = ((edges[1:] + edges[:-1]) / 2).double()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_histogram_raw(
            name,
            min=histogram.low,
            max=histogram.high,
            num=int(counts.sum()),
            sum=float(counts @ middles),
            sum_squares=float(counts @ middles**2),
            bucket_limits=edges[1:].tolist(),
            bucket_counts=counts.tolist(),
            global_step=step,
        )
    elif isinstance(logger, WandbLogger):
        import wandb  # an extra

        value = wandb.Histogram(np_histogram=(counts.numpy(), edges.numpy()))
        logger.experiment.log({name: value, "trainer/global_step": step})
