"""One scene's Gaussians, fitted to its photographs: where they start, merging, refinement."""

from asysplat.reconstruction.merge import merged, thinned
from asysplat.reconstruction.refine import Progress, Refinement, mean_colour, refine
from asysplat.reconstruction.settings import PAPER, Rates, Settings
from asysplat.reconstruction.start import gaussians_of_points, gaussians_of_prior

__all__ = [
    "PAPER",
    "Progress",
    "Rates",
    "Refinement",
    "Settings",
    "gaussians_of_points",
    "gaussians_of_prior",
    "mean_colour",
    "merged",
    "refine",
    "thinned",
]
