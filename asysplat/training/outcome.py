"""The outcome of a batch, for the losses to compare and the callbacks to measure and draw."""

from dataclasses import dataclass

from asysplat.rendering import Rendering
from asysplat.scene import Gaussians


@dataclass(frozen=True)
class Outcome:
    """What the network and the renderer made of a batch.

    Args:
        gaussians: predicted from the input views.
        rendering: of these Gaussians, at the target cameras.
    """

    gaussians: Gaussians
    rendering: Rendering
