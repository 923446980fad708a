"""Cases once more, in a process in which Triton interprets the kernels of "cuda"."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from backends import INTERPRETED

FILES = ("extents", "places", "opacities")


@pytest.mark.skipif(INTERPRETED, reason="this is that process")
@pytest.mark.parametrize("name", FILES)
def test_cases_in_the_interpreter(name):
    pytest.importorskip("triton")
    path = Path(__file__).with_name(f"test_{name}.py")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(path)],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
