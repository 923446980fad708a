"""What a network made of a batch: losses compare it, callbacks measure and draw it."""

from dataclasses import dataclass

from asysplat.rendering import Rendering
from asysplat.scene import Gaussians


@dataclass(frozen=True)
class Outcome:
    """
    Args:
        gaussians: of the input views.
        rendering: of them, at the target cameras.
    """

    gaussians: Gaussians
    rendering: Rendering
