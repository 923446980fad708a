"""Compilation of CPU kernels, cached on disk, and runs on as many threads as torch uses."""

import hashlib
import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import get_ident
from typing import TypeVar

import numba
import numpy as np
import torch
from numba import njit
from numba.core.caching import UserProvidedCacheLocator

PACKAGE = Path(__file__).parents[2]
FOLDERS = ("kernels", "ops", "rendering")  # folders with the sources of kernels
Result = TypeVar("Result")
PER_THREAD = 4  # portions of the work per thread, so that a faster thread can take more of them


def kernel(function: Callable) -> Callable:
    """Compile a kernel for `run_blocks` that runs without Python's global lock.

    With NUMBA_BOUNDSCHECK=1, the kernel checks every index.
    """
    config = numba.config
    before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR = _cache_folder(config.CACHE_DIR)
    config.CACHE_LOCATOR_CLASSES = f"{__name__}.{CacheBySources.__name__}"
    try:  # without a type checker's wrapper, which cannot be compiled
        return njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before


def inline(function: Callable) -> Callable:
    """Compile a function inline into each kernel that calls it."""
    return njit(inline="always", error_model="numpy")(inspect.unwrap(function))


class CacheBySources(UserProvidedCacheLocator):
    """Numba's cache of compiled kernels, which copies of the same sources share."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Return a kernel's folder in the cache: Numba's choice for files outside the package."""
        if not Path(py_file).is_relative_to(PACKAGE):
            return super().get_suitable_cache_subpath(py_file)
        return "-".join(Path(py_file).relative_to(PACKAGE).parent.parts)

    def get_source_stamp(self) -> str:
        """Return the hash of the kernel's file."""
        return hashlib.sha256(Path(self._py_file).read_bytes()).hexdigest()


@cache
def _cache_folder(parent: str) -> str:
    # Numba compares only the kernel's own file, not the files of the functions that it inlines.
    checks = "-checked" if numba.config.BOUNDSCHECK else ""
    name = f"kernels-{hash_sources()}{checks}"
    return str(Path(parent or find_home_cache() or Path(__file__).parent / "__pycache__") / name)


def hash_sources() -> str:
    """Hash the sources of all kernels and of the functions that they call."""
    paths = [path for folder in FOLDERS for path in (PACKAGE / folder).rglob("*.py")]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()[:16]


def find_home_cache() -> Path | None:
    """Return the user's cache folder; None where it cannot be written to."""
    folder = Path.home() / ".cache" / "asysplat"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def run_blocks(kernel: Callable[..., Result], bounds: np.ndarray, *args: object) -> list[Result]:
    """Run `kernel(start, stop, *args)` for each two consecutive bounds, on all threads.

    The results are returned in the order of the bounds. What a kernel computes for a block must not
    depend on the bounds, so that the number of threads changes no bit.
    """
    threads = torch.get_num_threads()
    ranges = [
        (a, b) for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True) if a < b
    ]
    if threads == 1 or len(ranges) == 1:
        return [kernel(start, stop, *args) for start, stop in ranges]
    pool = _pool(threads, get_ident())
    jobs = [pool.submit(kernel, start, stop, *args) for start, stop in ranges]
    return [job.result() for job in jobs]


def even_bounds(count: int) -> np.ndarray:
    """Divide `count` blocks of equal cost into portions; return the bounds."""
    return np.linspace(0, count, min(count, _portions()) + 1).astype(np.int64)


def weighted_bounds(ends: np.ndarray) -> np.ndarray:
    """Divide blocks of the cumulative costs [0, ..., total] evenly; return the bounds."""
    targets = np.linspace(ends[0], ends[-1], _portions() + 1)
    bounds = np.searchsorted(ends, targets)
    bounds[0], bounds[-1] = 0, len(ends) - 1
    return np.maximum.accumulate(bounds)


def _portions() -> int:
    threads = torch.get_num_threads()
    return 1 if threads == 1 else PER_THREAD * threads


@cache
def _pool(threads: int, caller: int) -> ThreadPoolExecutor:
    """Return the thread pool of a calling thread: callers do not wait for each other."""
    return ThreadPoolExecutor(threads, thread_name_prefix="asysplat")


# A forked process starts without its parent's threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
