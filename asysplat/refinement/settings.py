"""Settings of a refinement; conf/refinement says what each is, and has its values."""

import math
import sys
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from pydantic import Field
from pydantic.dataclasses import dataclass

from asysplat.errors import InputError
from asysplat.ranges import Count, Fraction, Index, NotNegative, configured
from asysplat.root import CONF

PIXELS_PER_GAUSSIAN = 8  # input pixels for each Gaussian, at least: with fewer, Gaussians fit noise


@dataclass(frozen=True, config=configured("refinement.rates"))
class Rates:
    """Learning rates of Adam; with 0 a field is not optimized and costs nothing."""

    means: NotNegative
    unit: Literal["pixel", "scene"]
    quats: NotNegative
    scales: NotNegative
    opacities: NotNegative
    sh: NotNegative
    sh_rest: NotNegative
    poses: NotNegative


@dataclass(frozen=True, config=configured("refinement.every"))
class StepSchedule:
    """What happens every so many steps, not at fractions of the refinement (Kerbl et al. 2023)."""

    round: Count
    first_round: Count
    opacity_reset: Count
    sh_degree: Count


@dataclass(frozen=True, config=configured("refinement"))
class RefinementSettings:
    """Settings of a refinement; `DEFAULT` is ours, `PAPER` the paper's, `FEW` for few views.

    Raises:
        pydantic.ValidationError: a number out of range.

    Example:
        >>> from dataclasses import replace
        >>> from asysplat.refinement import DEFAULT
        >>> settings = replace(DEFAULT, max_gaussians=50_000)
    """

    rates: Rates
    ssim: NotNegative | None
    depth: NotNegative
    robust: bool
    few_views: Index
    views_per_step: Count | None
    sh_degree: Annotated[int, Field(ge=0, le=3)] | None
    half_resolution_until: Fraction
    densify: Literal["error", "mcmc", "gradient", "none"]
    max_gaussians: Count | None
    initial_fraction: Fraction
    opacity_decay: Fraction
    densify_rounds: Index
    densify_until: Fraction
    every: StepSchedule | None
    final_lr_factor: Fraction
    cool_down: Fraction
    decay_means_alone: bool
    max_steps_per_image: Count | None

    def __post_init__(self):
        if self.every is not None and self.densify != "gradient":
            raise InputError("refinement.every: set densify=gradient, or every=null.")

    def limit(self, pixels: int) -> int:
        """Return the greatest number of Gaussians for input images of so many pixels together."""
        if self.densify == "gradient" and self.max_gaussians is None:  # as published
            return sys.maxsize
        return min(self.max_gaussians or sys.maxsize, max(1, pixels // PIXELS_PER_GAUSSIAN))

    @property
    def initial_limit(self) -> int:
        """The greatest number of Gaussians to start with: with few, early steps are fast."""
        if self.max_gaussians is None or self.densify not in ("error", "mcmc"):
            return self.max_gaussians or sys.maxsize
        return max(1, int(self.initial_fraction * self.max_gaussians))

    def max_steps(self, num_views: int) -> float:
        """Return the steps after which each image was used `max_steps_per_image` times."""
        if self.max_steps_per_image is None:
            return math.inf
        return self.max_steps_per_image * num_views / (self.views_per_step or num_views)


def read_settings(*names: str) -> Any:
    """Build the settings of a file of conf/refinement, or of several, each over those before."""
    files = (OmegaConf.load(CONF / "refinement" / f"{name}.yaml") for name in names)
    config: Any = OmegaConf.merge(*files)
    config.pop("defaults", None)
    return instantiate(config)


def for_views(config: DictConfig, num_views: int, given: Iterable[str] = ()) -> DictConfig:
    """Return the options of a refinement for so many views: for few, those of conf/refinement/few.

    Args:
        given: names of the options that stay.
    """
    few = num_views <= config.get("few_views", 0)
    return with_options(config, "refinement/few", given) if few else config


def with_options(config: DictConfig, file: str, given: Iterable[str]) -> DictConfig:
    """Return a configuration with the options of a file of conf, but for those that are given."""
    options: Any = OmegaConf.load(CONF / f"{file}.yaml")
    options.pop("defaults", None)
    merged: Any = OmegaConf.merge(config, options)
    for name in given:
        OmegaConf.update(merged, name, OmegaConf.select(config, name))
    return merged


DEFAULT: RefinementSettings = read_settings("default")
PAPER: RefinementSettings = read_settings("default", "paper")
FEW: RefinementSettings = read_settings("default", "few")
BRIEF: RefinementSettings = read_settings("default", "brief")
PUBLISHED_3DGS: RefinementSettings = read_settings("default", "3dgs")
