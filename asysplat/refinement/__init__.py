"""Fit the Gaussians of one scene to its images: initialization, merging, refinement."""

from asysplat.refinement.init import merge_to_limit
from asysplat.refinement.predict import predict, predict_in_windows
from asysplat.refinement.refine import Refinement, RefinementProgress, refine, without_unneeded
from asysplat.refinement.scaffold_gs import (
    SCAFFOLD_GS,
    AnchorScene,
    ScaffoldSettings,
    refine_scaffold,
)
from asysplat.refinement.settings import (
    BRIEF,
    DEFAULT,
    FEW,
    PAPER,
    PUBLISHED_3DGS,
    RefinementSettings,
    StepSchedule,
    for_views,
    with_options,
)

__all__ = [
    "BRIEF",
    "DEFAULT",
    "FEW",
    "PAPER",
    "PUBLISHED_3DGS",
    "SCAFFOLD_GS",
    "AnchorScene",
    "Refinement",
    "RefinementProgress",
    "RefinementSettings",
    "ScaffoldSettings",
    "StepSchedule",
    "for_views",
    "merge_to_limit",
    "predict",
    "predict_in_windows",
    "refine",
    "refine_scaffold",
    "with_options",
    "without_unneeded",
]
