"""TensorBoard: files of events that end at a checkpoint, and the hparams tab."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from asysplat.evaluation.metrics import METRICS
from asysplat.runs.runs import CHOICES

EVENTS = "events.out.tfevents.*"
TICKED = 5  # number of options that TensorBoard's hparams tab shows at first
FIRST = ("train", "val", "test", "steps")  # groups of cards
# In the group "steps", so that losses and metrics are the first cards of "train".
OF_STEPS = ("learning_rate", "grad_norm", "non_finite_steps", "bad_scenes")


class TensorBoard(TensorBoardLogger):
    """Lightning's logger, with the cards of FIRST before others: TensorBoard sorts by name."""

    def log_metrics(self, metrics: Mapping[str, int | float], step: int | None = None) -> None:
        super().log_metrics({_numbered(name): value for name, value in metrics.items()}, step)


def _numbered(name: str) -> str:
    """Put a number before the names of FIRST: 1_train/loss."""
    group, _, inner = name.partition("/")
    if group == "train" and inner in OF_STEPS:
        group, name = "steps", f"steps/{inner}"
    return f"{FIRST.index(group) + 1}_{name}" if group in FIRST else name


def event_files(loggers: Sequence[Logger]) -> dict[str, int]:
    """Flush all events to disk; return the name and bytes of each file of events."""
    sizes = {}
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.flush()
            paths = Path(logger.log_dir).glob(EVENTS)
            sizes |= {path.name: path.stat().st_size for path in paths}
    return sizes


@rank_zero_only
def cut_events(folder: Path, sizes: Mapping[str, int]) -> None:
    """Cut a run's files of events to the `sizes` that they had when its checkpoint was written.

    `purge_step` cannot do this: the last validation before and the first step after the checkpoint
    have the same step.
    """
    for path in (folder / "tensorboard").glob(EVENTS):
        if path.name not in sizes:
            path.unlink()
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])


def log_choices(logger: Logger, config: DictConfig) -> None:
    """Log the options for the hparams tab, which needs the names of its metrics now."""
    choices = {key: OmegaConf.select(config, key) for key in CHOICES}
    if isinstance(logger, TensorBoardLogger):  # sorts options by name
        choices = {
            f"{number}_{key}" if number <= TICKED else key: value
            for number, (key, value) in enumerate(choices.items(), 1)
        }
        logger.log_hyperparams(choices, {f"hp/{name}": 0 for name in METRICS})
    else:
        logger.log_hyperparams(choices)


def log_results(logger: Logger, results: Mapping[str, str | int | float], data: str) -> None:
    """Log the metrics of the test, for the hparams tab."""
    values = {f"hp/{name}": results.get(f"test/{data}/{name}") for name in METRICS}
    logger.log_metrics({name: value for name, value in values.items() if value is not None})
    logger.save()
