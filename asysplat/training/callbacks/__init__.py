"""Callbacks: metrics, costs, figures, bad scenes, non-finite steps, checkpoints, progress."""

from asysplat.training.callbacks.bad_scenes import BadScenes
from asysplat.training.callbacks.checkpoints import Checkpoints
from asysplat.training.callbacks.costs import Costs
from asysplat.training.callbacks.curve import Curve
from asysplat.training.callbacks.figures import Figures
from asysplat.training.callbacks.metrics import Metrics
from asysplat.training.callbacks.monitor import TrainingMonitor
from asysplat.training.callbacks.non_finite_steps import NonFiniteSteps
from asysplat.training.callbacks.progress import TrainingProgressBar
from asysplat.training.callbacks.stage_record import StageRecord

__all__ = [
    "BadScenes",
    "Checkpoints",
    "Costs",
    "Curve",
    "Figures",
    "Metrics",
    "NonFiniteSteps",
    "StageRecord",
    "TrainingMonitor",
    "TrainingProgressBar",
]
