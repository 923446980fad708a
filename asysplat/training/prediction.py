"""What the network and the renderer predict for a batch."""

from dataclasses import dataclass

from asysplat.rendering import Rendering
from asysplat.scene import Gaussians


@dataclass(frozen=True)
class Prediction:
    """Gaussians predicted from the input views, and their rendering at the target cameras.

    The Gaussians are those before pruning, which the terms of the loss are of, as in Long-LRM.
    """

    gaussians: Gaussians
    rendering: Rendering
