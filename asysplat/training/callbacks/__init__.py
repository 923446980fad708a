"""Callbacks: metrics, costs, figures, bad scenes, non-finite steps, averages, checkpoints."""

from asysplat.training.callbacks.checkpoints import Checkpoints, StageRecord
from asysplat.training.callbacks.costs import Costs
from asysplat.training.callbacks.figures import Curve, Figures
from asysplat.training.callbacks.metrics import Metrics
from asysplat.training.callbacks.monitor import TrainingMonitor
from asysplat.training.callbacks.skipped import BadScenes, NonFiniteSteps
from asysplat.training.callbacks.weight_average import WeightAverage, average_weights

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
    "WeightAverage",
    "average_weights",
]
