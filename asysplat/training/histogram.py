"""Count histograms of a network's predictions, scene by scene."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

BINS = 60


@dataclass
class Histogram:
    """Counts of numbers between two bounds; numbers beyond them are in the first or last bin."""

    low: float
    high: float
    counts: Float[Tensor, "bins"]  # float64, of bins of equal width

    @classmethod
    def empty(cls, low: float, high: float, device: torch.device) -> "Histogram":
        return cls(low, high, torch.zeros(BINS, dtype=torch.float64, device=device))

    @property
    def edges(self) -> Float[Tensor, "edges"]:
        return torch.linspace(self.low, self.high, len(self.counts) + 1)

    def add(self, numbers: Tensor) -> None:
        """Count numbers of any shape; NaN is ignored."""
        numbers = numbers[~numbers.isnan()].clamp(self.low, self.high)
        self.counts += torch.histc(numbers.float(), len(self.counts), self.low, self.high)

    def median(self) -> float:
        """Return the median, interpolated within its bin; NaN if nothing was counted."""
        counts = self.counts.cpu()
        below = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        if not below[-1]:
            return float("nan")
        bin = int(torch.searchsorted(below, below[-1] / 2)) - 1
        share = (below[-1] / 2 - below[bin]) / counts[bin]
        return (self.edges[bin] + share * (self.edges[1] - self.edges[0])).item()
