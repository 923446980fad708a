"""The options that several suites share: they are checked here, a mistake is one sentence."""

from collections.abc import Iterable
from importlib import import_module
from types import ModuleType

import torch

from asysplat.errors import InputError

SUITES = ("render", "ops", "model", "data", "reconstruct", "pareto", "bench", "stability")
PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}


def find_suite(name: str) -> ModuleType:
    """Import the file suite.py of the suite called `name`.

    Raises:
        InputError: no suite has this name.
    """
    check_names("suite", [name], SUITES)
    return import_module(f"asysplat.benchmark.{name}.suite")


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise InputError unless there are names for this option, and each is known."""
    for name in list(names) or [None]:
        if name not in known:
            raise InputError(f"{option}={name} is unknown: choose from {', '.join(known)}.")


def check_repeats(repeats: object) -> None:
    """Raise InputError unless it is a whole number from 1."""
    if not isinstance(repeats, int) or repeats < 1:
        raise InputError(f"repeats={repeats} cannot be: give a whole number from 1.")


def find_device(name: str) -> torch.device:
    """Return the device called `name`; "auto" is the GPU where there is one.

    Raises:
        InputError: another name, or a GPU that is not there.
    """
    check_names("device", [name], ("auto", "cpu", "cuda"))
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device=cuda is not there: torch finds no GPU; take device=cpu.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
