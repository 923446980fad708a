"""Ranges of options, which pydantic checks: types, and the most used options of train.py."""

from collections.abc import Mapping
from typing import Annotated, Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from asysplat.errors import first_mistake

Index = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
AtLeastTwo = Annotated[int, Field(ge=2)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveFraction = Annotated[float, Field(gt=0, le=1)]

TRAINING = {
    **dict.fromkeys(("steps", "validate_every", "state_size", "trainer.num_nodes"), Count),
    **dict.fromkeys(("width", "parameter_budget", "learning_rate"), Positive),
    "ema": Annotated[float, Field(gt=0, lt=1)] | None,
    "seed": Annotated[int, Field(ge=0, lt=2**32)],  # as NumPy takes them
    "geometry_ratio": Annotated[float, Field(gt=0, lt=1)] | None,
    **dict.fromkeys(("data.inputs", "data.targets", "data.height", "data.width"), Count),
    **dict.fromkeys(("data.batch_size", "data.micro_batch"), Count),
    **dict.fromkeys(("data.val_scenes", "data.test_scenes"), Count),
    "data.num_workers": Index,
    "data.window": Annotated[list[int], Field(min_length=2, max_length=2)] | None,
    "data.test_size": Annotated[list[Count], Field(min_length=2, max_length=2)] | None,
    "training.views_at_once": Count | None,
    "training.schedule.warmup_steps": Index,
    "training.optimizer.weight_decay": NotNegative,
    **{
        f"training.loss.{term}": NotNegative
        for term in ("mse", "ssim", "perceptual", "depth", "opacity")
    },
    "callbacks.non_finite_steps.budget": Count,
    "callbacks.monitor.every": Count,
    "callbacks.figures.scenes": Index,
    "callbacks.checkpoints.minutes": NotNegative | None,
}


def configured(title: str) -> ConfigDict:
    """Configure a dataclass whose fields are the options `title`.<name>."""
    return ConfigDict(title=title, extra="forbid", allow_inf_nan=False)


def check_options(options: Mapping[str, Any], ranges: Mapping[str, Any]) -> None:
    """Raise InputError for the first option out of its range; no type is converted."""
    for name, value in options.items():
        value = list(value) if isinstance(value, ListConfig) else value
        kind = TypeAdapter(ranges[name], config=ConfigDict(strict=True, allow_inf_nan=False))
        try:
            kind.validate_python(value)
        except ValidationError as error:
            raise first_mistake(error, name) from None


def check_training(config: DictConfig) -> None:
    """Check the options of `TRAINING` that a configuration has."""
    options = {name: OmegaConf.select(config, name, default=...) for name in TRAINING}
    check_options({k: value for k, value in options.items() if value is not ...}, TRAINING)
