"""Lightning wiring: the training step, its losses and the callbacks that measure and draw."""

from asysplat.training.disparity import InputDisparity, RenderedDisparity
from asysplat.training.losses import ReconstructionLoss
from asysplat.training.outcome import Outcome
from asysplat.training.reconstruction import Reconstruction
from asysplat.training.sharded import ShardedStrategy

__all__ = [
    "InputDisparity",
    "Outcome",
    "Reconstruction",
    "ReconstructionLoss",
    "RenderedDisparity",
    "ShardedStrategy",
]
