"""What can be measured: modules of this package that share three functions.

measure(options, console) -> results    plain numbers, words, lists and dictionaries
tables(results) -> list of rich tables
plot(results) -> figure
"""

from importlib import import_module
from types import ModuleType

from asysplat.errors import InputError

SUITES = ("render", "ops", "model", "data")


def find_suite(name: str) -> ModuleType:
    """The suite's module.

    Raises:
        InputError: no suite has this name.
    """
    if name not in SUITES:
        raise InputError(f"suite={name} is unknown: choose one of {', '.join(SUITES)}.")
    return import_module(f"asysplat.benchmark.{name}")
