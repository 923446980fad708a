"""Checks of the options that several suites share, and the machine that the suites run on."""

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

NAMES = ("render", "ops", "model", "data", "formats", "pareto", "systems")
NAMES = (*NAMES, "photographs", "bench", "device", "launches", "depths")
SUITES = {name: f"benchmarks.{name}" for name in NAMES}
SUITES |= {name: f"benchmarks.{name}.report" for name in ("public", "stability", "machine_code")}
PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}
CPU = torch.device("cpu")


def find_suite(name: str) -> ModuleType:
    """Import the suite called `name`."""
    check_names("suite", [name], SUITES)
    return import_module(SUITES[name])


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Check the names that an option was given."""
    for name in list(names) or [None]:
        if name not in known:
            raise InputError(f"{option}={name} is unknown: choose from {', '.join(known)}.")


def describe_machine() -> dict[str, str | int]:
    """Return the processor, its cores, torch's threads, any GPU, and versions of packages."""
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
