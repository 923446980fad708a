"""Seconds and errors, measured alike in every suite."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from asysplat.evaluation.measured_cost import wait_for

Result = dict[str, Any]  # plain values, as JSON has them
Run = Callable[[], object]
Timer = Callable[[], Mapping[Hashable, float]]  # seconds by name

BUSY = 0.3  # interquartile range over median, above which other programs disturbed a measurement


@dataclass
class Measurement:
    """One row of a suite's results, and the seconds that `time_in_rounds` adds to it."""

    timer: Timer  # runs once everything of the row that is timed
    row: Result = field(default_factory=dict)  # results besides the times
    seconds: dict[Hashable, list[float]] = field(default_factory=dict)

    def summary(self, name: Hashable) -> Result:
        return summary(self.seconds[name])


def time_in_rounds(
    measurements: Sequence[Measurement], repeats: int, console: Console | None = None
) -> None:
    """Call every timer in each of `repeats` rounds, after a round to warm up.

    Measurements take turns, so that other load on the machine affects all of them alike. The
    console, if there is one, shows the progress.
    """
    rounds = range(repeats + 1)
    for number in track(rounds, "rounds", console=console, transient=True, disable=not console):
        for measurement in measurements:
            for name, seconds in measurement.timer().items():
                if number > 0:
                    measurement.seconds.setdefault(name, []).append(seconds)


def summary(values: Sequence[float]) -> Result:
    """Return median and interquartile range, and whether the machine was busy."""
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "iqr": high - low, "busy": high - low > BUSY * median}


def device_time(device: torch.device) -> float:
    """Return the clock's seconds at which the device has finished its work."""
    wait_for(device)
    return time.perf_counter()


def measure_run(run: Run, device: torch.device) -> float:
    """Return the seconds of one run, until the device has finished it."""
    start = device_time(device)
    run()
    return device_time(device) - start


def relative_l2(tensor: Tensor, exact: Tensor) -> float:
    """Return the norm of the difference over the norm of `exact`, a float64 tensor."""
    return ((tensor.cpu().double() - exact).norm() / exact.norm()).item()
