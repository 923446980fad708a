"""One scene's Gaussians, fitted to its photographs: where they start, merging, refinement."""

from asysplat.refinement.merge import merged, thinned
from asysplat.refinement.refine import Refinement, RefinementProgress, mean_color, refine
from asysplat.refinement.settings import PAPER, Rates, RefinementSettings
from asysplat.refinement.start import gaussians_of_points, gaussians_of_prior

__all__ = [
    "PAPER",
    "Rates",
    "Refinement",
    "RefinementProgress",
    "RefinementSettings",
    "gaussians_of_points",
    "gaussians_of_prior",
    "mean_color",
    "merged",
    "refine",
    "thinned",
]
