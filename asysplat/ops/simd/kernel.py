"""Compilation of the CPU kernels: cached on disk, and run without Python's global lock."""

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
    """Compile a kernel for `run_blocks`; with NUMBA_BOUNDSCHECK=1 it checks every index."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _cache_folder(before)
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(_bare(function))
    finally:
        numba.config.CACHE_DIR = before


def inline(function: Callable) -> Callable:
    """Compile a function inline into each kernel that calls it."""
    return njit(inline="always", error_model="numpy")(_bare(function))


def _bare(function: Callable) -> Callable:
    """Remove a type checker's wrapper, which cannot be compiled."""
    return inspect.unwrap(function)


@cache
def _cache_folder(parent: str) -> str:
    """Return the folder for this version of the sources; bounds-checked kernels have their own.

    Numba compares only a kernel's own file: it would reuse a kernel after changes of its parts in
    other files.
    """
    paths = [path for folder in ("ops", "rendering") for path in (PACKAGE / folder).rglob("*.py")]
    sources = b"".join(path.read_bytes() for path in sorted(paths))
    beside = HERE / "__pycache__"
    home = Path.home() / ".cache" / "asysplat"
    root = parent or (beside if os.access(HERE, os.W_OK) else home)
    checks = "-checked" if numba.config.BOUNDSCHECK else ""
    return str(Path(root) / f"kernels-{hashlib.sha256(sources).hexdigest()[:16]}{checks}")
