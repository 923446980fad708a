"""What a measurement was taken on."""

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import llvmlite.binding
import torch

CPU_INFO = Path("/proc/cpuinfo")  # Linux alone
PACKAGES = ("torch", "numba", "triton", "gsplat")


def describe_machine() -> dict[str, str | int]:
    """Name the processor, cores, torch's threads, the GPU if any, and versions of PACKAGES."""
    machine = {
        "cpu": _processor(),
        "instructions": llvmlite.binding.get_host_cpu_name(),  # what Numba compiles for
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
    }
    if torch.cuda.is_available():
        machine["gpu"] = torch.cuda.get_device_name()
    for package in PACKAGES:
        try:
            machine[package] = version(package)
        except PackageNotFoundError:
            continue
    return machine


def _processor() -> str:
    """Return the model's name as the system has it."""
    if CPU_INFO.exists():
        found = re.search(r"model name\s*:\s*(.+)", CPU_INFO.read_text())
        if found:
            return found[1]
    return platform.processor() or platform.machine()
