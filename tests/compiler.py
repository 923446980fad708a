"""Where tests of Triton's kernels run: on a GPU, or in its interpreter on a CPU."""

import os

import pytest

# Triton reads TRITON_INTERPRET when it is first imported: tests of "cuda" run a second time in a
# process that has it set, on a CPU.
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"


def kernel(test):
    """Run a test where there is a device for kernels."""
    return test if INTERPRETED else pytest.mark.gpu(test)
