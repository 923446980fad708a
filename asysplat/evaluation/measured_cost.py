"""Measure the seconds and the peak memory of repeated work."""

import ctypes
import gc
import os
import re
import resource
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch

GB = 1e9
STATUS, CLEAR_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")  # Linux alone
SECONDS = (
    "mean of all measurements but the longest, which is left out as an outlier; "
    "of a single measurement, that one"
)


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


def memory_gb(device: torch.device | str) -> float:
    """Return the memory of the device in 1e9 bytes; for a CPU, that of the machine."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory / GB
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GB


def reset_peak_memory(device: torch.device | str) -> bool:
    """Reset the peak that `peak_memory_gb` reads to the memory in use now.

    Returns:
        Whether the peak was reset: on CUDA, and on Linux if /proc is writable.
    """
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return True
    try:
        CLEAR_PEAK.write_text("5")
    except OSError:
        return False
    return True


def memory_before_gb(device: torch.device | str) -> float:
    """Return freed memory to the system, reset the peak, and return the memory in use now.

    Without this, work that reuses freed memory would not raise the peak.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL(None).malloc_trim(0)
    reset_peak_memory(device)
    return peak_memory_gb(device)


def peak_memory_gb(device: torch.device | str) -> float:
    """Read the peak memory in 1e9 bytes since `reset_peak_memory` or the process's start.

    On CUDA this is the memory of the tensors; elsewhere the resident set of the whole process, with
    libraries, data, and freed memory that was not returned to the system.
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / GB
    if STATUS.exists():
        kilobytes = re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())[1]
        return int(kilobytes) * 1024 / GB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return peak * bytes_per_unit / GB
