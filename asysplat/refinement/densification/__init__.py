"""What a refinement calls to add, move and remove Gaussians."""

from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.scene import Cameras, Views


class Densifier:
    """Keeps the Gaussians as they are; a method of densification overrides what it needs."""

    def observe_view(self, gradients: Float[Tensor, "N 3"], cameras: Cameras) -> None:
        """Take note of the gradients of the offsets from one view."""

    def observe_step(self, visible: Bool[Tensor, "N"], factor: float) -> None:
        """Take note of a step of the optimizer, or add to it.

        `visible` are the Gaussians that a view of the step shows; `factor` is that of the rates.
        """

    def densify(self, views: Views, target: int) -> None:
        """Prune, add or move Gaussians; with `target`, their number grows evenly to the limit."""
