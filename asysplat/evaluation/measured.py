"""What work takes that is done again and again: seconds, and memory at its peak."""

import statistics
import time
from collections.abc import Sequence

import torch

from asysplat.evaluation.cost import peak_memory_gb, reset_peak_memory

SECONDS = (
    "mean of all measurements but the longest, which is left out as an outlier; "
    "of a single measurement, that one"
)


def mean_but_longest(seconds: Sequence[float]) -> float:
    """Mean of all but the longest, of one alone that one (paper, Suppl., "Inference overhead")."""
    return statistics.fmean(sorted(seconds)[:-1] or seconds)


def wait_for(device: torch.device) -> None:
    """A GPU works on after the call returns; a time is taken when it has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Measured:
    """Seconds and peak memory of work between a `start` and a `stop`, of each time it was done.

    Several share one peak: none may start between the start and the stop of another.

    Args:
        device: where the work is done.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.seconds: list[float] = []
        self.gb: list[float] = []  # see `peak_memory_gb`; left empty where no peak starts anew

    def start(self) -> None:
        wait_for(self.device)
        self._anew = reset_peak_memory(self.device)
        self._started = time.perf_counter()

    def stop(self) -> None:
        wait_for(self.device)
        self.seconds.append(time.perf_counter() - self._started)
        if self._anew:
            self.gb.append(peak_memory_gb(self.device))

    def costs(self, name: str) -> dict[str, float]:
        """<name>_seconds (`mean_but_longest`) and <name>_gb (the largest); {} if never done."""
        costs = {}
        if self.seconds:
            costs[f"{name}_seconds"] = mean_but_longest(self.seconds)
        if self.gb:
            costs[f"{name}_gb"] = max(self.gb)
        return costs
