"""Check the values of the most used options, before any work starts."""

import math
import sys
from collections.abc import Callable, Sequence
from typing import TypeGuard

from omegaconf import DictConfig, ListConfig, OmegaConf

from asysplat.errors import InputError

SEEDS = 2**32  # NumPy takes seeds below it


def is_whole(value: object, low: int | float = 0, below: int | float = math.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value < below


def is_number(value: object) -> TypeGuard[float]:
    # Not math.isfinite, which no whole number of 310 digits passes without an OverflowError.
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and abs(value) <= sys.float_info.max


def is_window(value: object, low: int | float = -math.inf) -> bool:
    return (
        isinstance(value, ListConfig) and [is_whole(number, low) for number in value] == [True] * 2
    )


# The expected value, its check, and the options.
RANGES: tuple[tuple[str, Callable[[object], bool], Sequence[str]], ...] = (
    (
        "a whole number of at least 1",
        lambda value: is_whole(value, 1),
        (
            *("steps", "validate_every", "state_size", "trainer.num_nodes"),
            *(f"data.{key}" for key in ("inputs", "targets", "height", "width", "batch_size")),
            *(f"data.{key}" for key in ("val_scenes", "test_scenes", "micro_batch")),
            *("callbacks.non_finite_steps.budget", "callbacks.monitor.every"),
        ),
    ),
    (
        "a whole number of at least 1, or null for all at once",
        lambda value: value is None or is_whole(value, 1),
        ["training.views_at_once"],
    ),
    (
        "a whole number of at least 0",
        is_whole,
        (
            *("data.num_workers", "training.schedule.warmup_steps"),
            "callbacks.figures.scenes",
        ),
    ),
    (f"a whole number from 0 to {SEEDS - 1}", lambda value: is_whole(value, 0, SEEDS), ["seed"]),
    (
        "a number above 0",
        lambda value: is_number(value) and value > 0,
        ["width", "parameter_budget", "learning_rate"],
    ),
    (
        "a number of at least 0",
        lambda value: is_number(value) and value >= 0,
        (
            "training.optimizer.weight_decay",
            *(f"training.loss.{key}" for key in ("mse", "ssim", "perceptual", "depth", "opacity")),
        ),
    ),
    (
        "a fraction between 0 and 1, such as 0.9, or null for the model's own",
        lambda value: value is None or (is_number(value) and 0 < value < 1),
        ["geometry_ratio"],
    ),
    (
        "a number above 0 and up to 1, or null to skip nothing",
        lambda value: value is None or (is_number(value) and 0 < value <= 1),
        ["speed.skip_layers_above", "speed.skip_network_above"],
    ),
    (
        "a number of at least 0, or null",
        lambda value: value is None or (is_number(value) and value >= 0),
        ["callbacks.checkpoints.minutes"],
    ),
    (
        "two whole numbers, such as [64,96], or null for all images",
        lambda value: value is None or is_window(value),
        ["data.window"],
    ),
    (
        "height and width in pixels, such as [64,96], or null for the size that trains",
        lambda value: value is None or is_window(value, 1),
        ["data.test_size"],
    ),
)


def check_ranges(config: DictConfig) -> None:
    """Check the options of `RANGES` that the configuration has."""
    absent = object()
    for expected, fits, keys in RANGES:
        for key in keys:
            value = OmegaConf.select(config, key, default=absent)
            if value is not absent and not fits(value):
                raise InputError(f"{key}={'null' if value is None else value}: give {expected}.")
