"""Fit the Gaussians of one scene to its images: initialization, merging, refinement."""

from asysplat.refinement.merge import merge_to_limit
from asysplat.refinement.refine import Refinement, RefinementProgress, refine
from asysplat.refinement.settings import (
    PAPER,
    PUBLISHED_3DGS,
    Rates,
    RefinementSettings,
    StepSchedule,
)

__all__ = [
    "PAPER",
    "PUBLISHED_3DGS",
    "Rates",
    "Refinement",
    "RefinementProgress",
    "RefinementSettings",
    "StepSchedule",
    "merge_to_limit",
    "refine",
]
