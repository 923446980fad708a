"""Cases once more, in a process in which Triton interprets the kernels of "cuda".

The interpreter is slow: here are some of each kind. All: TRITON_INTERPRET=1 pytest tests/stress
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from backends import INTERPRETED

# What is left of each file, as pytest's -k says it.
SOME = {
    "bad_input": "",
    "boundary_band": "random and depth",
    "culled": "case_01 or case_02 and nan or case_06 and inf and True or case_09 and quaternion"
    " or case_14 and median or case_32 and (opacities and near or means and 1e38)",
    "extents": "not case_08",
    "gradchecks": "",
    "memory_and_types": "strided or bfloat16-None",
    "needles": "1e6",
    "opacities": "not gsplat",
    "places": "not case_12 and not case_13 or 1e+06 or 0.01",
    "properties": "permutation or cropping",
    "sizes": "case_15 and not 4096",
    "threads_and_order": "equal_depths",
}


@pytest.mark.skipif(INTERPRETED, reason="this is that process")
@pytest.mark.parametrize("name", SOME)
def test_cases_in_the_interpreter(name):
    pytest.importorskip("triton")
    path = Path(__file__).with_name(f"test_{name}.py")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(path), "-k", SOME[name]],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
