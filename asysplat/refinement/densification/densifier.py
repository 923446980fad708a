"""What a refinement calls to add, move and remove Gaussians."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.scene import Cameras, Gaussians, Views


class Densifier:
    """Keeps the Gaussians as they are; a method of densification overrides what it needs."""

    def regularizer(self, gaussians: Gaussians) -> Tensor | float:
        """Compute a term that is added to the loss of each view."""
        return 0.0

    def observe_view(self, gradients: Float[Tensor, "N 3"], cameras: Cameras) -> None:
        """Take note of the gradients of the offsets from one view."""

    def observe_step(self, visible: Bool[Tensor, "N"], factor: float) -> None:
        """Take note of a step of the optimizer, or add to it.

        Args:
            visible: Gaussians that a view of the step shows.
            factor: factor of the learning rates.
        """

    def densify(self, views: Views, target: int) -> None:
        """Prune, add or move Gaussians.

        Args:
            views: input views.
            target: number of Gaussians after this round, on an even growth to the limit.
        """


def random_permutation(count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Sample a permutation on the generator's device."""
    return torch.randperm(count, generator=generator, device=generator.device)


def random_normal(
    rows: int, columns: int, generator: torch.Generator
) -> Float[Tensor, "rows columns"]:
    """Sample standard normal numbers on the generator's device."""
    return torch.randn(rows, columns, generator=generator, device=generator.device)
