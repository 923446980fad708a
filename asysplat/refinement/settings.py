"""Settings of a refinement: learning rates, loss, schedule and densification."""

import math
import sys
from dataclasses import dataclass, field
from typing import Literal, get_args

from asysplat.errors import InputError

Densify = Literal["error", "mcmc", "gradient", "none"]
Unit = Literal["pixel", "scene"]
PIXELS_PER_GAUSSIAN = 8  # input pixels for each Gaussian, at least: with fewer, Gaussians fit noise


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam; with 0 a field is not optimized and costs nothing."""

    means: float = 0.4  # rate of means, in `unit`
    unit: Unit = "pixel"  # its size at the Gaussian; "scene": the farthest camera's distance
    quats: float = 8e-3  # rate of unit quaternions
    scales: float = 0.04  # rate of log scales
    opacities: float = 0.4  # rate of opacity logits
    sh: float = 0.02  # rate of SH of degree 0
    sh_rest: float = 0.05  # rate of SH of higher degrees, as a multiple of `sh`
    exposure: float = 0.0  # rate of each image's log gain and offset per channel
    poses: float = 0.0  # rate of each image's rotation, in radians, and position, in scene units

    def __post_init__(self):
        """Check the ranges."""
        for name, value in vars(self).items():
            if name != "unit" and not 0 <= value < math.inf:
                raise InputError(f"refinement.rates.{name}={value}: give a number >= 0.")
        if self.unit not in get_args(Unit):
            raise InputError(f"refinement.rates.unit={self.unit}: choose pixel or scene.")


@dataclass(frozen=True)
class StepSchedule:
    """What happens every so many steps, not at fractions of the refinement (Kerbl et al. 2023)."""

    round: int = 100  # steps from one round of densification to the next
    first_round: int = 500
    opacity_reset: int = 3000  # to at most MAX_RESET_OPACITY
    sh_degree: int = 1000  # raised by one, from 0

    def __post_init__(self):
        """Check the ranges."""
        for name, value in vars(self).items():
            if value < 1:
                raise InputError(f"refinement.every.{name}={value}: give at least 1.")


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of a refinement: the default is ours, `PAPER` the paper's post-optimization.

    Raises:
        InputError: a number out of range.
    """

    rates: Rates = field(default_factory=Rates)
    ssim: float | None = 0.2  # weight of 1 - SSIM beside L1; None: the mean squared error alone
    views_per_step: int | None = 1  # input views rendered in a step; None: all
    sh_degree: int | None = 1  # 0 to 3; None keeps the degree of the Gaussians
    half_resolution_until: float = 0.25  # initial part of the refinement, at half the image size
    # "error": spawn Gaussians at pixels with a large error; "mcmc": relocate dead ones (Kheradmand
    # et al. 2024); "gradient": clone and split by screen-space gradients (Kerbl et al. 2023).
    densify: Densify = "error"
    # Lower if all input images have fewer than 8 pixels for each; None: no other limit.
    max_gaussians: int | None = 150_000
    initial_fraction: float = 0.19  # fraction of max_gaussians to start with, at most
    densify_rounds: int = 12  # each multiplies the number of Gaussians by the same factor
    densify_until: float = 0.6  # initial part of the refinement, with densification
    # Schedule of densify="gradient"; None: `densify_rounds`, evenly.
    every: StepSchedule | None = None
    final_lr_factor: float = 0.05  # factor of the rates at the end of the cool-down
    decay_means_alone: bool = False  # True: only the rate of means decays
    cool_down: float = 0.5  # last part of the refinement, in which the rates fall
    # Steps with each input image that end it, whatever time is left: more would fit noise.
    max_steps_per_image: int | None = 400

    def __post_init__(self):
        """Check the ranges."""
        fractions = ("half_resolution_until", "initial_fraction", "densify_until")
        for name in (*fractions, "final_lr_factor", "cool_down"):
            self._check(name, 0 <= getattr(self, name) <= 1, "give 0 to 1")
        choices = get_args(Densify)
        self._check("densify", self.densify in choices, f"choose {', '.join(choices)}")
        self._check("sh_degree", self.sh_degree in (None, 0, 1, 2, 3), "choose 0, 1, 2, 3 or null")
        self._check("densify_rounds", self.densify_rounds >= 0, "give at least 0")
        steps = self.every is None or self.densify == "gradient"
        self._check("every", steps, "set densify=gradient, or every=null")
        for name in ("views_per_step", "max_steps_per_image", "max_gaussians"):
            value = getattr(self, name)
            self._check(name, value is None or value >= 1, "give at least 1, or null")

    def _check(self, name: str, valid: bool, fix: str) -> None:
        if not valid:
            raise InputError(f"refinement.{name}={getattr(self, name)}: {fix}.")

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


# Suppl. A, "Post optimization": as Long-LRM does.
PAPER = RefinementSettings(
    Rates(means=5e-4, unit="scene", sh=1e-3, sh_rest=1.0, quats=0.0, scales=0.0, opacities=0.0),
    ssim=None,
    views_per_step=None,
    sh_degree=None,
    half_resolution_until=0.0,
    densify="none",
    cool_down=0.0,
    max_steps_per_image=None,
)

# 3DGS as published (Kerbl et al. 2023; graphdeco-inria/gaussian-splatting, arguments/__init__.py).
# Its extent of a scene is 1.1 times the distance of the farthest camera, our unit.
PUBLISHED_3DGS = RefinementSettings(
    Rates(means=1.76e-4, unit="scene", quats=1e-3, scales=5e-3, opacities=0.05, sh=2.5e-3),
    sh_degree=3,
    half_resolution_until=0.0,
    densify="gradient",
    max_gaussians=None,
    densify_until=0.5,
    every=StepSchedule(),
    final_lr_factor=0.01,
    decay_means_alone=True,
    cool_down=1.0,
    max_steps_per_image=None,
)
