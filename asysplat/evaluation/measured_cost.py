"""Measure the seconds and the peak memory of repeated work."""

import statistics
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from asysplat.evaluation.cost import peak_memory_gb, reset_peak_memory
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

SECONDS = (
    "mean of all measurements but the longest, which is left out as an outlier; "
    "of a single measurement, that one"
)
RENDERINGS = 6  # timed; the longest, which may include compilation, is left out


def mean_but_longest(seconds: Sequence[float]) -> float:
    """Compute the mean of all measurements but the longest; return a single one as it is.

    Source: the paper's supplement, "Inference overhead".
    """
    return statistics.fmean(sorted(seconds)[:-1] or seconds)


def wait_for(device: torch.device) -> None:
    """Wait until a GPU has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class CostMeter:
    """Measures seconds and peak memory from each `start` to its `stop`.

    All meters share the process's peak, so their intervals must not overlap.

    Args:
        device: of the work.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.seconds: list[float] = []
        self.gb: list[float] = []  # see `peak_memory_gb`; empty where the peak cannot be reset

    def start(self) -> None:
        wait_for(self.device)
        self._peak_was_reset = reset_peak_memory(self.device)
        self._started = time.perf_counter()

    def stop(self) -> None:
        wait_for(self.device)
        self.seconds.append(time.perf_counter() - self._started)
        if self._peak_was_reset:
            self.gb.append(peak_memory_gb(self.device))

    def costs(self, name: str) -> dict[str, float]:
        """Return <name>_seconds (`mean_but_longest`) and <name>_gb (the largest), if measured."""
        costs = {}
        if self.seconds:
            costs[f"{name}_seconds"] = mean_but_longest(self.seconds)
        if self.gb:
            costs[f"{name}_gb"] = max(self.gb)
        return costs


def render_seconds(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, depth: bool
) -> float:
    """Measure the seconds of one rendering with the gradients of all Gaussian fields.

    Args:
        gaussians, cameras, background, depth: as for `render`.

    Returns:
        The `mean_but_longest` of RENDERINGS renderings.
    """
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    meter = CostMeter(gaussians.means.device)
    for _ in range(RENDERINGS):
        meter.start()
        with torch.enable_grad():
            out = render(leaves, cameras, background, depth=depth)
            total = out.image.sum() if out.depth is None else out.image.sum() + out.depth.sum()
        total.backward()
        meter.stop()
    return mean_but_longest(meter.seconds)
