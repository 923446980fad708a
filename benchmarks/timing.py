"""Seconds and errors, measured in the same way in every suite."""

import math
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
Timer = Callable[[], Mapping[Hashable, float]]  # returns seconds by name

BUSY = 0.3  # ratio of interquartile range to median above which the machine counts as busy


@dataclass
class Measurement:
    """One row of a suite's results, and the seconds that `time_in_rounds` collects for it."""

    timer: Timer  # runs once all that the row times
    row: Result = field(default_factory=dict)  # results besides the times
    seconds: dict[Hashable, list[float]] = field(default_factory=dict)

    def summarize(self, name: Hashable) -> Result:
        return summarize(self.seconds[name])


def time_in_rounds(
    measurements: Sequence[Measurement],
    repeats: int,
    console: Console | None = None,
    seconds: float = math.inf,
) -> None:
    """Call every timer once in each of `repeats` rounds, after a round to warm up.

    Measurements take turns, so that other load on the machine affects all of them alike. Progress
    is shown if there is a console. From the second round on, none begins after `seconds`.
    """
    rounds, start = range(repeats + 1), time.perf_counter()
    for number in track(rounds, "rounds", console=console, transient=True, disable=not console):
        if number > 1 and time.perf_counter() - start > seconds:
            break
        for measurement in measurements:
            for name, duration in measurement.timer().items():
                if number > 0:
                    measurement.seconds.setdefault(name, []).append(duration)


def summarize(values: Sequence[float]) -> Result:
    """Return the median and the interquartile range, and whether the machine was busy."""
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "iqr": high - low, "busy": high - low > BUSY * median}


def device_time(device: torch.device) -> float:
    """Return the clock in seconds, read after the device has finished its work."""
    wait_for(device)
    return time.perf_counter()


def measure_run(run: Run, device: torch.device) -> float:
    """Return the seconds of one run, up to the moment when the device has finished it."""
    start = device_time(device)
    run()
    return device_time(device) - start


def relative_l2(tensor: Tensor, exact: Tensor) -> float:
    """Return the L2 norm of the difference over that of `exact`, a float64 tensor on the CPU."""
    return ((tensor.cpu().double() - exact).norm() / exact.norm()).item()
