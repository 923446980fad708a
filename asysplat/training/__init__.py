"""Training: the LightningModule, its losses and its callbacks."""

from asysplat.training.disparity import InputDisparity, RenderedDisparity
from asysplat.training.losses import SplattingLoss
from asysplat.training.module import SplattingModule
from asysplat.training.prediction import Prediction
from asysplat.training.sharded import ShardedStrategy

__all__ = [
    "InputDisparity",
    "Prediction",
    "RenderedDisparity",
    "ShardedStrategy",
    "SplattingLoss",
    "SplattingModule",
]
