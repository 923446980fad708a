"""Lightning wiring: the training step, its losses and the callbacks that measure and draw."""

from asysplat.training.losses import ReconstructionLoss
from asysplat.training.reconstruction import Reconstruction

__all__ = ["Reconstruction", "ReconstructionLoss"]
