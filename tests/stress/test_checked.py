"""Tests of the CPU kernels run again with bounds checks, in processes whose memory is poisoned."""

import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from backends import INTERPRETED
from poison import FILLS

from asysplat.kernels.simd.gathers import gather_pairs, gather_squares
from asysplat.kernels.simd.threads import kernel
from asysplat.kernels.simd.vectors import load, load_some, store, zeros
from asysplat.rendering.cpu.math import sum_and_clear

CHECKED = bool(numba.config.BOUNDSCHECK)
ONE, EIGHT, LAST = np.float32(1), np.float32(8), np.float32(15)
# Not the kernels of the renderer and of ssd, which compile for a minute.
QUICK = ("stress/test_checked.py", "ops/test_image_loss.py")
CASES = "step_out or computes"
ALL = ("stress", "ops", "refinement/test_adam.py")
slow = pytest.mark.slow
NOT_LONG = "test and not long and not interpreter"


@kernel
def _step_out(which, numbers, rows):
    if which == 0:
        numbers[len(numbers)] = 1
    elif which == 1:
        sum_and_clear(numbers, len(numbers) - 15)
    elif which == 2:
        store(rows, len(rows), load(rows, 0))
    elif which == 3:
        store(rows, 0, load_some(numbers, len(numbers) - 3, 4))
    elif which == 4:  # the last number has none to its right,
        store(rows, 0, gather_squares(rows, zeros(), zeros() + LAST)[0])
    elif which == 5:  # and none below
        store(rows, 0, gather_squares(rows, zeros() + ONE, zeros())[0])
    elif which == 6:
        store(rows, 0, gather_pairs(numbers.reshape(2, 8, 2), zeros() + ONE, zeros() + EIGHT)[0])


@pytest.mark.skipif(not CHECKED, reason="without bounds checks it overwrites memory")
@pytest.mark.parametrize("which", range(7))
def test_a_step_out_of_an_array_is_an_error(which):
    with pytest.raises(IndexError):
        _step_out(which, np.zeros(32, np.float32), np.zeros((2, 16), np.float32))


@pytest.mark.medium
@pytest.mark.timeout(3600)
@pytest.mark.skipif(INTERPRETED or CHECKED, reason="this is such a process")
@pytest.mark.skipif(sys.platform != "linux", reason="memory is poisoned by glibc")
@pytest.mark.parametrize(
    "paths, cases, marked, fill",
    [
        pytest.param(QUICK, CASES, "not slow", FILLS[0], id="quick"),
        *[
            pytest.param(ALL, NOT_LONG, "not slow", fill, id=f"all, {fill:x}", marks=slow)
            for fill in FILLS
        ],
        pytest.param(ALL[:1], "thousand_steps", "slow", FILLS[0], id="soak", marks=slow),
    ],
)
def test_kernels_with_bounds_checks_and_in_poisoned_memory(repository, paths, cases, marked, fill):
    files = [str(repository / "tests" / path) for path in paths]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            *files,
            "-k",
            cases,
            "-m",
            marked,
        ],
        # Malloc fills its memory with the complement.
        env={
            **os.environ,
            "NUMBA_BOUNDSCHECK": "1",
            "GLIBC_TUNABLES": f"glibc.malloc.perturb={fill ^ 0xFF}",
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
