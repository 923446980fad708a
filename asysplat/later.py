"""Names of a package that are imported when first used, since torch takes seconds."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


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
