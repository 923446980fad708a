"""Seconds, memory and errors: how every suite measures them."""

import inspect
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from asysplat.evaluation.cost import memory_before_gb, peak_memory_gb
from asysplat.evaluation.measured_cost import wait_for

Result = dict[str, Any]  # plain values, as JSON has them
Run = Callable[[], object]
Timer = Callable[[], Mapping[Hashable, float]]  # seconds by name
Name = Callable[[FrameType], str | None]

BUSY = 0.3  # interquartile range over median, above which the machine was busy with other things


@dataclass
class Measurement:
    """One row of a suite's results."""

    timer: Timer  # runs everything that is timed of it once
    found: Result = field(default_factory=dict)  # results besides the times
    seconds: dict[Hashable, list[float]] = field(default_factory=dict)  # by `time_in_rounds`

    def summary(self, name: Hashable) -> Result:
        """Summarize the seconds of this name."""
        return summary(self.seconds[name])


def time_in_rounds(measurements: Sequence[Measurement], repeats: int) -> None:
    """Call every timer in each of `repeats` rounds, after a round to warm up.

    In turns, so that whatever else the machine does meets all measurements alike.
    """
    for number in range(repeats + 1):
        for measurement in measurements:
            for name, seconds in measurement.timer().items():
                if number > 0:
                    measurement.seconds.setdefault(name, []).append(seconds)


def summary(values: Sequence[float]) -> Result:
    """Return median and interquartile range, and whether the machine was busy."""
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "iqr": high - low, "busy": is_busy(median, high - low)}


def is_busy(median: float, iqr: float) -> bool:
    """Tell whether a measurement spreads too much to be relied on."""
    return iqr > BUSY * median


def ratios(one: Result, other: Result, names: Iterable[str]) -> dict[str, float | None]:
    """Divide medians by those of another result; None for what one of them was not timed for."""
    return {
        name: one[name]["median"] / other[name]["median"] if one[name] and other[name] else None
        for name in names
    }


def now(device: torch.device) -> float:
    """Return the clock's seconds at which the device has finished its work."""
    wait_for(device)
    return time.perf_counter()


def seconds_of(run: Run, device: torch.device) -> float:
    """Return the seconds of one run, until the device has finished it."""
    start = now(device)
    run()
    return now(device) - start


@contextmanager
def time_calls(
    functions: Mapping[Callable, Name], device: torch.device
) -> Iterator[dict[str, float]]:
    """Add up the seconds of every call of some functions, as Python's profiler sees them.

    Args:
        functions: what names a call of each, from its frame; None for a call to leave out.

    Yields:
        The seconds by name.
    """
    names = {inspect.unwrap(function).__code__: name for function, name in functions.items()}
    seconds: dict[str, float] = {}

    def profile(frame: FrameType, event: str, _: object) -> None:
        if frame.f_code in names and event in ("call", "return"):
            name = names[frame.f_code](frame)
            if name is not None:
                clock = -now(device) if event == "call" else now(device)
                seconds[name] = seconds.get(name, 0.0) + clock

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        yield seconds
    finally:
        sys.setprofile(previous)


def rise_gb(run: Run, device: torch.device) -> float:
    """Return the peak memory of a run above what was held before it, in 1e9 bytes.

    A first run warms it up. Too small where a process cannot start its peak anew: on a CPU without
    Linux.
    """
    run()
    before = memory_before_gb(device)
    run()
    wait_for(device)
    return peak_memory_gb(device) - before


def relative_l2(found: Tensor, true: Tensor) -> float:
    """Return the norm of the difference over the norm of what is true, a float64 tensor."""
    return ((found.cpu().double() - true).norm() / true.norm()).item()
