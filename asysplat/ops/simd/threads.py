"""Kernels on as many threads as torch uses."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import get_ident
from typing import TypeVar

import numpy as np
import torch

Result = TypeVar("Result")
PER_THREAD = 4  # portions of the work for each thread: the fast threads take more of them


def run_blocks(kernel: Callable[..., Result], bounds: np.ndarray, *args: object) -> list[Result]:
    """Run `kernel(start, stop, *args)` for neighboring numbers of `bounds`, in any order.

    The results are returned in the order of `bounds`. A kernel's output must depend on its range
    alone, so that the number of threads changes no bit.
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
    """Divide `count` blocks of equal cost into portions."""
    return np.linspace(0, count, min(count, _portions()) + 1).astype(np.int64)


def weighted_bounds(ends: np.ndarray) -> np.ndarray:
    """Divide blocks with cumulative costs `ends`, [0, ..., total], into portions."""
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
