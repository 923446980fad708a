"""What a refinement may change, how fast, and when."""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from asysplat.errors import InputError

Densify = Literal["error", "mcmc", "gradient", "none"]
Unit = Literal["pixel", "scene"]


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam; a field with 0 stays as it is and costs nothing.

    Args:
        means: in the unit that `unit` names: what a pixel covers at a Gaussian's distance, or the
            scene's unit, in which the farthest camera is at distance 1 from their middle.
        quats: of quaternions about as long as 1.
        scales: of their logarithms.
        opacities: of their logits.
        sh: of SH of degree 0; those of higher degrees have `higher` times that.
        exposure: of a gain's logarithm and an offset a channel, of each photograph.
        poses: of each photograph's rotation, in radians, and position, in the scene's unit.
    """

    means: float = 0.4
    unit: Unit = "pixel"
    quats: float = 8e-3
    scales: float = 0.04
    opacities: float = 0.4
    sh: float = 0.02
    higher: float = 0.05
    exposure: float = 0.0
    poses: float = 0.0


@dataclass(frozen=True)
class RefinementSettings:
    """How Gaussians are refined: the default is ours, `PAPER` the paper's post-optimization.

    Args:
        rates: of what changes.
        ssim: weight of 1 - SSIM beside L1; None: the mean squared error alone.
        views_a_step: photographs that a step looks at; None: all of them.
        sh_degree: 0 to 3; None keeps that of the Gaussians. Higher degrees join one by one.
        half_size: share of the refinement that looks at photographs of half the size.
        densify: "error": new Gaussians where pixels are wrong; "mcmc": those of no use move to
            where others are (Kheradmand et al. 2024); "gradient": those whose images are pulled
            are cloned or split (Kerbl et al. 2023); "none".
        most: Gaussians up to which densification adds more, if all photographs together have 8
            pixels for each.
        rounds: how often Gaussians are added and dropped, over the first `until` of the refinement.
        until: see `rounds`.
        growth: share of the Gaussians that a round adds, at most, beside as many as it drops.
        decay: of all rates over the last `cool_down` of the refinement.
        cool_down: see `decay`.
        looks: steps at each photograph after which a refinement ends, whatever time is left: more
            of them fit its noise. None: no such end.

    Raises:
        InputError: a number out of range.
    """

    rates: Rates = field(default_factory=Rates)
    ssim: float | None = 0.2
    views_a_step: int | None = 1
    sh_degree: int | None = 1
    half_size: float = 0.25
    densify: Densify = "error"
    most: int = 150_000
    rounds: int = 12
    until: float = 0.6
    growth: float = 0.15
    decay: float = 0.05
    cool_down: float = 0.5
    looks: int | None = 400

    def __post_init__(self):
        """Check the ranges."""
        shares = ("half_size", "until", "growth", "decay", "cool_down")
        for name in shares:
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"refinement.{name}={getattr(self, name)}: give 0 to 1.")
        if self.densify not in get_args(Densify):
            raise InputError(
                f"refinement.densify={self.densify}: choose {', '.join(get_args(Densify))}."
            )
        if self.rates.unit not in ("pixel", "scene"):
            raise InputError(f"refinement.rates.unit={self.rates.unit}: choose pixel or scene.")
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InputError(f"refinement.sh_degree={self.sh_degree}: choose 0, 1, 2, 3 or null.")
        least_views = 1 if self.views_a_step is None else self.views_a_step
        if self.most < 1 or self.rounds < 0 or least_views < 1:
            raise InputError(
                f"refinement has most={self.most}, rounds={self.rounds} and "
                f"views_a_step={self.views_a_step}: give at least 1 Gaussian, 0 rounds and 1 view."
            )
        if self.looks is not None and self.looks < 1:
            raise InputError(f"refinement.looks={self.looks}: give at least 1, or null.")

    def most_steps(self, num_views: int) -> float:
        """Return the steps after which each photograph has been looked at `looks` times."""
        if self.looks is None:
            return math.inf
        return self.looks * num_views / (self.views_a_step or num_views)


# Suppl. A, "Post optimization": as Long-LRM does.
PAPER = RefinementSettings(
    rates=Rates(
        means=5e-4, unit="scene", sh=1e-3, higher=1.0, quats=0.0, scales=0.0, opacities=0.0
    ),
    ssim=None,
    views_a_step=None,
    sh_degree=None,
    half_size=0.0,
    densify="none",
    cool_down=0.0,
    looks=None,
)
