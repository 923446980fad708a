"""How long a run takes and how much memory: what several suites measure alike."""

import ctypes
import gc
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress

import numpy as np
import torch

from asysplat.evaluation.cost import peak_memory_gb, reset_peak_memory
from asysplat.evaluation.measured_cost import wait_for

Run = Callable[[], object]
Timer = Callable[[], Mapping[Hashable, float]]


def seconds_of(run: Run, device: torch.device) -> float:
    """Of one run, until the device has finished it."""
    wait_for(device)
    start = time.perf_counter()
    run()
    wait_for(device)
    return time.perf_counter() - start


def run_timer(key: Hashable, run: Run, device: torch.device) -> Timer:
    """The time of a run, under its key."""
    return lambda: {key: seconds_of(run, device)}


def rounds(timers: Iterable[Timer], repeats: int) -> dict[Hashable, list[float]]:
    """What the timers find in `repeats` rounds, after one to warm up.

    Every timer runs once a round: whatever else the machine does meets all of them alike.
    """
    timers, found = list(timers), {}
    for number in range(repeats + 1):
        for timer in timers:
            for key, value in timer().items():
                if number > 0:
                    found.setdefault(key, []).append(value)
    return found


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Median and interquartile range."""
    low, median, high = np.percentile(seconds, [25, 50, 75]).tolist()
    return {"median": median, "iqr": high - low}


def rise_gb(run: Run, device: torch.device) -> float:
    """What a run takes beyond what there was before it, in 1e9 bytes, after one to warm up.

    Too small where a process cannot start its peak anew: on a CPU without Linux.
    """
    run()
    _give_back_memory()
    reset_peak_memory(device)
    before = peak_memory_gb(device)
    run()
    wait_for(device)
    return peak_memory_gb(device) - before


def _give_back_memory() -> None:
    """To the system what was freed: a run that is given it again would not show as a rise."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
