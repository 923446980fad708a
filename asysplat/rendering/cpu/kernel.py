"""How every function here is compiled: once, kept on disk, and without Python's lock."""

import inspect
from collections.abc import Callable

from numba import njit


def kernel(function: Callable) -> Callable:
    """A function that a thread is sent into."""
    return njit(cache=True, nogil=True, error_model="numpy")(_bare(function))


def inline(function: Callable) -> Callable:
    """A part of kernels, compiled into each of them."""
    return njit(inline="always", error_model="numpy")(_bare(function))


def _bare(function: Callable) -> Callable:
    """Without what a type checker has put around it, which cannot be compiled."""
    return inspect.unwrap(function)
