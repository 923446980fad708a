"""Training: the LightningModule, its losses and its callbacks."""

from asysplat.training.losses.disparity import InputDisparity, LogDepth, RenderedDisparity
from asysplat.training.losses.splatting import SplattingLoss
from asysplat.training.module import SplattingModule
from asysplat.training.optimizers import Muon
from asysplat.training.parallel import Prediction, ShardedStrategy

__all__ = [
    "InputDisparity",
    "LogDepth",
    "Muon",
    "Prediction",
    "RenderedDisparity",
    "ShardedStrategy",
    "SplattingLoss",
    "SplattingModule",
]
