"""Fill uninitialized memory, so that a kernel that reads it changes its results.

Floats of torch and of NumPy on the host become NaN and integers the largest; memory from malloc,
also that of kernels, is filled with one byte.
"""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace
from unittest import mock

import numpy as np
import torch

# The module that allocates by NumPy outside of kernels; in the package, `draw` is a function.
draw = import_module("asysplat.rendering.cpu.draw")
M_PERTURB = -6  # of mallopt (glibc)
# As float32 and as int32: 3.4e38 and 2139062143; -1.2e-38 and -2139062144.
FILLS = (0x7F, 0x80)


@contextmanager
def poisoned(fill: int | None) -> Iterator[None]:
    """Fill uninitialized memory; None leaves it as it is."""
    if fill is None:
        yield
        return
    numpy = SimpleNamespace(**{**vars(np), "empty": _empty, "empty_like": _empty_like})
    perturb(fill ^ 0xFF)  # it fills with the complement
    torch.use_deterministic_algorithms(True)  # and with it torch.empty is filled
    try:
        with mock.patch.object(draw, "np", numpy):
            yield
    finally:
        torch.use_deterministic_algorithms(False)
        perturb(0)


def perturb(byte: int) -> None:
    """Make malloc fill its memory with a byte; 0 stops that."""
    if sys.platform == "linux" and not ctypes.CDLL(None).mallopt(M_PERTURB, byte):
        raise OSError("mallopt refuses M_PERTURB")


def _empty(shape, dtype=np.float64, **options) -> np.ndarray:
    dtype = np.dtype(dtype)
    worst = np.nan if dtype.kind == "f" else True if dtype.kind == "b" else np.iinfo(dtype).max
    return np.full(shape, worst, dtype, **options)


def _empty_like(array: np.ndarray, **options) -> np.ndarray:
    return _empty(array.shape, array.dtype, **options)
