"""Run some cases again, in a process in which Triton interprets the kernels of "cuda".

The interpreter is slow, so these are some of each kind. All of them:
TRITON_INTERPRET=1 pytest tests/stress
"""

from pathlib import Path

import pytest
from backends import INTERPRETED
from compiler import run_interpreted

# The cases of each file, as an expression of pytest's -k.
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
    "properties": "cropping",
    "sizes": "case_15 and not 4096",
    "threads_and_order": "equal_depths",
}


# Two processes, of a minute each.
HALVES = [list(SOME)[:3], list(SOME)[3:]]


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="this is that process")
@pytest.mark.parametrize("names", HALVES, ids=" ".join)
def test_cases_in_the_interpreter(names):
    pytest.importorskip("triton")
    paths = [str(Path(__file__).with_name(f"test_{name}.py")) for name in names]
    some = [f"test_{name}.py and ({SOME[name] or 'test'})" for name in names]
    run_interpreted(*paths, "-k", " or ".join(some))
