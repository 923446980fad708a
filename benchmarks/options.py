"""The options that several suites share, and the machine that they run on."""

import os
import platform
from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from types import ModuleType

import llvmlite.binding
import torch

from asysplat.doctor import processor
from asysplat.errors import InputError

NAMES = ("render", "ops", "model", "data", "formats", "pareto", "bench")
SUITES = {name: f"benchmarks.{name}" for name in NAMES}
SUITES["stability"] = "benchmarks.stability.report"
PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}
CPU = torch.device("cpu")


def find_suite(name: str) -> ModuleType:
    """Import the suite called `name`; raise InputError where no suite has this name."""
    check_names("suite", [name], SUITES)
    return import_module(SUITES[name])


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise InputError unless this option has at least one name, and all names are known."""
    for name in list(names) or [None]:
        if name not in known:
            raise InputError(f"{option}={name} is unknown: choose from {', '.join(known)}.")


def describe_machine() -> dict[str, str | int]:
    """Return the processor, cores, torch's threads, the GPU if any, and versions of packages."""
    machine = {
        "cpu": processor(),
        "instructions": llvmlite.binding.get_host_cpu_name(),  # what Numba compiles for
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numba": version("numba"),
    }
    if torch.cuda.is_available():
        machine["gpu"] = torch.cuda.get_device_name()
    return machine | ({"triton": version("triton")} if find_spec("triton") else {})
