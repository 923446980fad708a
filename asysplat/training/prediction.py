"""What the network and the renderer predict for a batch."""

from dataclasses import dataclass

from asysplat.rendering import Rendering
from asysplat.scene import Gaussians


@dataclass(frozen=True)
class Prediction:
    """The prediction for a batch.

    Args:
        gaussians: predicted from the input views.
        rendering: of these Gaussians at the target cameras.
    """

    gaussians: Gaussians
    rendering: Rendering
