"""What a measurement was taken on."""

import os
import platform
import re
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import llvmlite.binding
import torch

CPU_INFO = Path("/proc/cpuinfo")  # Linux alone
PACKAGES = ("torch", "numba", "triton", "gsplat")


def describe_machine() -> dict[str, str | int]:
    """Name the processor, cores, torch's threads, the GPU if any, and versions of PACKAGES."""
    found = CPU_INFO.exists() and re.search(r"model name\s*:\s*(.+)", CPU_INFO.read_text())
    machine = {
        "cpu": found[1] if found else platform.processor() or platform.machine(),
        "instructions": llvmlite.binding.get_host_cpu_name(),  # what Numba compiles for
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
    }
    if torch.cuda.is_available():
        machine["gpu"] = torch.cuda.get_device_name()
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            machine[package] = version(package)
    return machine
