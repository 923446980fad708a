"""Measure the seconds and the peak memory of work; memory and speed of a device."""

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
TERA = 1e12
# By torch's name of the device: dense bf16, TF32 and fp32 in TFLOP/s, from NVIDIA's data sheets.
PEAKS = {
    "NVIDIA H200": (989.4, 494.7, 66.9),
    "NVIDIA H100 80GB HBM3": (989.4, 494.7, 66.9),
    "NVIDIA H100 PCIe": (756.0, 378.0, 51.2),
    "NVIDIA A100-SXM4-40GB": (312.0, 156.0, 19.5),
    "NVIDIA A100-SXM4-80GB": (312.0, 156.0, 19.5),
    "NVIDIA A100 80GB PCIe": (312.0, 156.0, 19.5),
    "NVIDIA L40S": (362.0, 183.0, 91.6),
    "NVIDIA RTX A6000": (154.8, 77.4, 38.7),
    "NVIDIA GeForce RTX 4090": (165.2, 82.6, 82.6),
    "NVIDIA GeForce RTX 3090": (71.0, 35.6, 35.6),
}
PEAK_MEMORY = {"cpu": "resident set", "cuda": "peak allocated"}  # what `peak_memory_gb` reads
STATUS, CLEAR_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")  # Linux alone
SECONDS = (
    "of training steps the mean; of inference the mean of all measurements but the longest, which "
    "is left out as an outlier, or a single measurement"
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


def peak_flops(device: torch.device, precision: str) -> float | None:
    """Return the peak of a device in FLOP/s; None if unknown, and for every CPU.

    Args:
        precision: Lightning's, such as bf16-mixed or 32-true.
    """
    if device.type != "cuda" or torch.cuda.get_device_name(device) not in PEAKS:
        return None
    half, tf32, single = PEAKS[torch.cuda.get_device_name(device)]
    if "16" in precision:
        return TERA * half
    return TERA * (single if torch.get_float32_matmul_precision() == "highest" else tf32)
