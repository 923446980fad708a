"""How every kernel for CPUs is compiled: once, kept on disk, and without Python's lock."""

import hashlib
import inspect
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numba
from numba import njit

HERE = Path(__file__).parent
PACKAGE = HERE.parent.parent


def kernel(function: Callable) -> Callable:
    """Compile what threads run; with NUMBA_BOUNDSCHECK=1 every index is checked, for tests."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _cache_folder(before)
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(_bare(function))
    finally:
        numba.config.CACHE_DIR = before


def inline(function: Callable) -> Callable:
    """Compile a function into each kernel that calls it."""
    return njit(inline="always", error_model="numpy")(_bare(function))


def _bare(function: Callable) -> Callable:
    """Take off what a type checker has put around a function, which cannot be compiled."""
    return inspect.unwrap(function)


@cache
def _cache_folder(asked: str) -> str:
    """Return the folder for this version of the sources, checked kernels in one of their own.

    Numba itself looks only at a kernel's own file: it would go on using a compiled kernel whose
    parts, in other files, have changed.
    """
    paths = [path for folder in ("ops", "rendering") for path in (PACKAGE / folder).rglob("*.py")]
    sources = b"".join(path.read_bytes() for path in sorted(paths))
    beside = HERE / "__pycache__"
    home = Path.home() / ".cache" / "asysplat"
    root = asked or (beside if os.access(HERE, os.W_OK) else home)
    checks = "-checked" if numba.config.BOUNDSCHECK else ""
    return str(Path(root) / f"kernels-{hashlib.sha256(sources).hexdigest()[:16]}{checks}")
