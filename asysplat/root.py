"""The version, where the files beside the code are, and names that are imported when first used."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parent
# A wheel carries what lies beside the package in a repository; see pyproject.toml.
INSTALLED = PACKAGE / "installed"
ROOT = INSTALLED if INSTALLED.is_dir() else PACKAGE.parent
CONF = ROOT / "conf"
try:
    __version__ = version("asysplat")
except PackageNotFoundError:  # a copy that is not installed
    __version__ = "unknown"


def typed(script: str) -> str:
    """Return how the command of a script is typed here: `python train.py`, or `asysplat train`."""
    return f"python {script}.py" if Path.cwd() == ROOT else f"asysplat {script}"


def import_later(package: str, places: Mapping[str, str]) -> Callable[[str], object]:
    """Return the `__getattr__` of a package that imports its names from `places`, by name."""

    def find(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        # Stored, since importing asysplat.load leaves the module under the name of its function.
        value = getattr(import_module(places[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return find
