"""TensorBoard: a first page of quality, training and time, and the hparams tab."""

from collections.abc import Mapping
from pathlib import Path

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

CHOICES = (
    "name",
    "seed",
    "width",
    "state_size",
    "geometry_ratio",
    "steps",
    "learning_rate",
    "model.layers",
    "data.name",
    "data.inputs",
    "data.height",
    "data.width",
    "data.batch_size",
    "metrics.name",
    "training.loss.ssim",
    "training.loss.perceptual",
    "training.loss.depth",
    "training.loss.opacity",
)
TERMS = ("mse", "ssim", "perceptual", "depth", "opacity")
HPARAMS_METRICS = ("psnr", "ssim", "lpips", "absrel")

PAGE = {
    "quality": {
        "PSNR (dB)": ["Multiline", ["train/psnr", "val/psnr", "val/nearest_view/psnr"]],
        "SSIM": ["Multiline", ["val/ssim"]],
        "LPIPS": ["Multiline", ["val/lpips"]],
        "AbsRel": ["Multiline", ["val/absrel"]],
    },
    "training": {
        "loss": ["Multiline", [f"train/{term}" for term in ("loss", *TERMS)]],
        "gradient norm": ["Multiline", ["train/grad_norm", "gradient/.*"]],
        "learning rate": ["Multiline", ["train/learning_rate"]],
    },
    "time": {
        "share of a step": ["Multiline", ["time/share_.*"]],
        "views a second": ["Multiline", ["time/views_per_second"]],
    },
}


def make_logger(folder: Path | str) -> TensorBoardLogger:
    """Make a logger whose "custom scalars" page shows quality first."""
    logger = TensorBoardLogger(folder, name="tensorboard", version="", default_hp_metric=False)
    logger.experiment.add_custom_scalars(PAGE)
    return logger


def log_choices(logger: Logger, config: DictConfig) -> None:
    """Log options; for the hparams tab, metrics must be named before they are known."""
    choices = {key: OmegaConf.select(config, key) for key in CHOICES}
    if isinstance(logger, TensorBoardLogger):
        logger.log_hyperparams(choices, {f"hp/{name}": 0 for name in HPARAMS_METRICS})
    else:
        logger.log_hyperparams(choices)


def log_outcome(logger: Logger, results: Mapping[str, str | int | float], data: str) -> None:
    """Log the test's numbers, for the hparams tab."""
    found = {f"hp/{name}": results.get(f"test/{data}/{name}") for name in HPARAMS_METRICS}
    logger.log_metrics({name: value for name, value in found.items() if value is not None})
    logger.save()
