"""Callbacks: what is measured and drawn, what may go wrong, checkpoints, progress."""

from asysplat.training.callbacks.checkpoints import Checkpoints
from asysplat.training.callbacks.costs import Costs
from asysplat.training.callbacks.curve import Curve
from asysplat.training.callbacks.guard import SkipNonFiniteSteps
from asysplat.training.callbacks.metrics import Metrics
from asysplat.training.callbacks.pictures import Pictures
from asysplat.training.callbacks.progress import Progress
from asysplat.training.callbacks.skipped import Skipped
from asysplat.training.callbacks.skipped_scenes import SkippedScenes
from asysplat.training.callbacks.watch import Watch

__all__ = [
    "Checkpoints",
    "Costs",
    "Curve",
    "Metrics",
    "Pictures",
    "Progress",
    "SkipNonFiniteSteps",
    "Skipped",
    "SkippedScenes",
    "Watch",
]
