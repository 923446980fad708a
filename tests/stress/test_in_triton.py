"""Run tests of "cuda" again, in processes in which Triton interprets its kernels on a CPU.

The interpreter is slow, so of the stress cases these are some of each kind. All of them:
TRITON_INTERPRET=1 pytest tests/stress
"""

import os
import subprocess
import sys

import pytest
from backends import INTERPRETED

# The cases of each file here, as an expression of pytest's -k.
SOME = {
    "bad_input": "",
    "boundary_band": "random and depth",
    "culled": "case_06 and inf and True or case_09 and quaternion or case_14 and median"
    " or case_32 and (NaN and not sh or opacities and near or means and 1e38)",
    "extents": "not case_08",
    "gradchecks": "",
    "memory_and_types": "strided or bfloat16-None",
    "needles": "1e6",
    "opacities": "not gsplat",
    "places": "not case_12 and not case_13 or 1e+06 or 0.01",
    "properties": "cropping",
    "sizes": "case_15 and not 4096",
    "threads_and_order": "equal_depths",
}
CASES = [f"test_{name}.py and ({SOME[name] or 'test'})" for name in SOME]
# Each in a process, of a minute at most.
RUNS = [
    ("stress", " or ".join(CASES[:3])),
    ("stress", " or ".join(CASES[3:])),
    ("rendering/test_cuda.py", "test"),
    ("ops/test_cuda_scans.py", "test"),
    ("ops/test_plane_sweep.py", "cuda"),
]


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="this is that process")
@pytest.mark.parametrize("path, cases", RUNS)
def test_cases_in_the_interpreter(repository, path, cases):
    pytest.importorskip("triton")
    command = ["-m", "pytest", "-p", "no:cacheprovider", str(repository / "tests" / path)]
    done = subprocess.run(
        [sys.executable, *command, "-k", cases],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
