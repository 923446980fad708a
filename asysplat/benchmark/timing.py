"""Seconds and memory: how every suite measures them."""

import ctypes
import gc
import inspect
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import numpy as np
import torch

from asysplat.evaluation.cost import peak_memory_gb, reset_peak_memory
from asysplat.evaluation.measured_cost import wait_for

Result = dict[str, Any]  # plain values, as JSON has them
Run = Callable[[], object]
Timer = Callable[[], Mapping[Hashable, float]]  # seconds by name
Name = Callable[[FrameType], str | None]


@dataclass
class Measurement:
    """One row of a suite's results.

    Args:
        timer: runs everything that is timed of it once.
        found: results besides the times.
        seconds: those of every round, by name; `time_in_rounds` fills them.
    """

    timer: Timer
    found: Result = field(default_factory=dict)
    seconds: dict[Hashable, list[float]] = field(default_factory=dict)

    def summary(self, name: Hashable) -> dict[str, float]:
        """Return median and interquartile range of the seconds of this name."""
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


def summary(values: Sequence[float]) -> dict[str, float]:
    """Return median and interquartile range."""
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "iqr": high - low}


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
    """Add up the seconds of every call of some functions, by name; see `watch_calls`."""
    seconds: dict[str, float] = {}

    def clock(name: str, begins: bool) -> None:
        seconds[name] = seconds.get(name, 0.0) + (-now(device) if begins else now(device))

    with watch_calls(functions, clock):
        yield seconds


@contextmanager
def watch_calls(
    functions: Mapping[Callable, Name], watch: Callable[[str, bool], None]
) -> Iterator[None]:
    """Report every call of some functions to `watch`, as Python's profiler does.

    Args:
        functions: what names a call of each, from its frame; None for a call to leave out.
        watch: given that name, and whether the call begins or ends.
    """
    names = {inspect.unwrap(function).__code__: name for function, name in functions.items()}

    def profile(frame: FrameType, event: str, _: object) -> None:
        if frame.f_code in names and event in ("call", "return"):
            name = names[frame.f_code](frame)
            if name is not None:
                watch(name, event == "call")

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(previous)


def rise_gb(run: Run, device: torch.device) -> float:
    """Return the peak memory of a run above what was held before it, in 1e9 bytes.

    A first run warms it up. Too small where a process cannot start its peak anew: on a CPU without
    Linux.
    """
    run()
    _return_freed_memory()
    reset_peak_memory(device)
    before = peak_memory_gb(device)
    run()
    wait_for(device)
    return peak_memory_gb(device) - before


def _return_freed_memory() -> None:
    """Return freed memory to the system: a run that gets it again would not show as a rise."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
