"""Measure the seconds and the peak memory of work, and the memory of a device."""

import os
import re
import resource
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

GB = 1e9
PEAK_MEMORY = {"cpu": "resident set", "cuda": "peak allocated"}  # what `peak_memory_gb` reads
STATUS, CLEAR_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")  # Linux alone
SECONDS = (
    "of training steps the mean; of inference the mean of all measurements but the longest, which "
    "is left out as an outlier, or a single measurement"
)


def mean_but_longest(seconds: Sequence[float]) -> float:
    """Compute the mean of all but the longest, as the paper's "Inference overhead", or of one."""
    return statistics.fmean(sorted(seconds)[:-1] or seconds)


def wait_for(device: torch.device) -> None:
    """Wait until a GPU has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class CostMeter:
    """Measures seconds and peak memory from each `start` to its `stop`; meters must not overlap."""

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


def memory_gb(device: torch.device | str) -> float:
    """Return the memory of the device in 1e9 bytes; for a CPU, that of the machine."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory / GB
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GB


def reset_peak_memory(device: torch.device | str) -> bool:
    """Reset the peak that `peak_memory_gb` reads; return whether this was possible."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return True
    try:
        CLEAR_PEAK.write_text("5")
    except OSError:
        return False
    return True


def peak_memory_gb(device: torch.device | str) -> float:
    """Read the peak memory in 1e9 bytes since `reset_peak_memory` or the process's start.

    On CUDA of the tensors; elsewhere the resident set of the process, with libraries, data, and
    freed memory that was not returned to the system.
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / GB
    if STATUS.exists():
        kilobytes = re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())[1]
        return int(kilobytes) * 1024 / GB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / GB
