"""All kernels for CPUs with bounds checks and in poisoned memory, in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from backends import INTERPRETED


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="kernels for GPUs are interpreted there")
@pytest.mark.skipif(sys.platform != "linux", reason="memory is poisoned by glibc")
def test_kernels_with_bounds_checks_and_in_poisoned_memory():
    script = Path(__file__).with_name("checked_kernels.py")
    done = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "NUMBA_BOUNDSCHECK": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("the same bits") == 5
