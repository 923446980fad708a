"""Run tests of "cuda" again, in a process in which Triton interprets its kernels on a CPU.

The interpreter is slow, so of the stress cases these are some of each kind. All of them:
TRITON_INTERPRET=1 pytest tests/stress
"""

import os
import subprocess
import sys

import pytest
from backends import INTERPRETED

# Small cases of each kernel: the renderer's, and those of the operators.
KERNELS = ("rendering/test_cuda.py", "ops/test_cuda_scans.py", "ops/test_plane_sweep.py")
KERNELS = (*KERNELS, "ops/test_image_loss.py", "ops/test_cuda_conv_silu.py")
LARGE = "blobs or wide or mixed"
# The cases of each file here, as an expression of pytest's -k.
STRESS = {
    "boundary_band": "depth",
    "culled": "nothing and median or poison and opacities",
    "extremes": "not alpha and not gsplat",
    "gradchecks": "",
    "memory_and_types": "strided or bfloat16",
    "needles": "needles",
    "properties": "cropping",
    "sizes": "odd and not 4096",
    "threads_and_order": "equal_depths",
}
CASES = " or ".join(f"test_{name}.py and ({STRESS[name] or 'test'})" for name in STRESS)


@pytest.mark.medium
@pytest.mark.timeout(1800)
@pytest.mark.skipif(INTERPRETED, reason="this is that process")
@pytest.mark.parametrize(
    "paths, cases",
    [
        pytest.param(KERNELS[:1], f"cuda and not ({LARGE})", id="the renderer's"),
        pytest.param(KERNELS, f"cuda and not ({LARGE})", marks=pytest.mark.slow, id="all"),
        pytest.param(KERNELS, f"cuda and ({LARGE})", marks=pytest.mark.slow, id="large"),
        pytest.param(("stress",), CASES, marks=pytest.mark.slow, id="stress"),
    ],
)
def test_cases_in_the_interpreter(repository, paths, cases):
    pytest.importorskip("triton")
    files = [str(repository / "tests" / path) for path in paths]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *files, "-k", cases],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
