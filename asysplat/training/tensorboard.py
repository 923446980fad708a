"""TensorBoard: a first page of quality and training, and the hparams tab."""

from collections.abc import Mapping
from pathlib import Path

from lightning.pytorch.loggers import TensorBoardLogger
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
)
TERMS = ("mse", "ssim", "perceptual", "depth")
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
        "gradient norm": ["Multiline", ["train/grad_norm"]],
        "learning rate": ["Multiline", ["train/learning_rate"]],
    },
}


def make_logger(folder: Path) -> TensorBoardLogger:
    """Make a logger whose "custom scalars" page shows quality first."""
    logger = TensorBoardLogger(folder, name="tensorboard", version="", default_hp_metric=False)
    logger.experiment.add_custom_scalars(PAGE)
    return logger


def log_choices(logger: TensorBoardLogger, config: DictConfig) -> None:
    """Fill the hparams tab with options; its metrics must be named before they are known."""
    choices = {key: OmegaConf.select(config, key) for key in CHOICES}
    logger.log_hyperparams(choices, {f"hp/{name}": 0 for name in HPARAMS_METRICS})


def log_outcome(
    logger: TensorBoardLogger, results: Mapping[str, str | int | float], data: str
) -> None:
    """Fill the hparams tab with the test's numbers."""
    found = {f"hp/{name}": results.get(f"test/{data}/{name}") for name in HPARAMS_METRICS}
    logger.log_metrics({name: value for name, value in found.items() if value is not None})
    logger.save()
