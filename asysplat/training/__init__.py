"""Lightning wiring: the training step, its losses and the callbacks that measure and draw."""

from asysplat.training.disparity import InputDisparity, RenderedDisparity
from asysplat.training.losses import SplattingLoss
from asysplat.training.module import SplattingModule
from asysplat.training.outcome import Outcome
from asysplat.training.sharded import ShardedStrategy

__all__ = [
    "InputDisparity",
    "Outcome",
    "RenderedDisparity",
    "ShardedStrategy",
    "SplattingLoss",
    "SplattingModule",
]
