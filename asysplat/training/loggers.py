"""What a run is logged to besides its files, and what of it is no number: pictures, histograms."""

from importlib.util import find_spec
from pathlib import Path

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from matplotlib.figure import Figure

from asysplat.errors import InputError
from asysplat.training.histogram import Histogram


def make_wandb_logger(folder: Path | str, project: str, name: str, offline: bool) -> WandbLogger:
    """Make a logger to Weights & Biases, which wants an account unless it is offline.

    Args:
        folder: of the run.
        project, name: under which the run is shown.
        offline: keep everything in the folder; `wandb sync` sends it later.

    Raises:
        InputError: wandb is not installed.
    """
    if find_spec("wandb") is None:
        raise InputError(
            "logger=wandb needs wandb: pip install 'asysplat[wandb]', or take logger=tensorboard, "
            "which needs no account."
        )
    return WandbLogger(save_dir=folder, project=project, name=name, offline=offline)


def log_figure(logger: Logger, name: str, figure: Figure, step: int) -> None:
    """Log a figure where the logger shows figures."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_figure(name, figure, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [figure], step)


def log_histogram(logger: Logger, name: str, histogram: Histogram, step: int) -> None:
    """Log a histogram where the logger shows histograms."""
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

        shown = wandb.Histogram(np_histogram=(counts.numpy(), edges.numpy()))
        logger.experiment.log({name: shown, "trainer/global_step": step})
