"""Helpers of the GPU kernels (Triton): how they are compiled, and token indices."""

import inspect
from collections.abc import Callable

import triton
import triton.language as tl

INTERPRETED = triton.knobs.runtime.interpret  # Triton runs on a CPU, in NumPy: for tests
# A launch may fuse products and sums where no kernel decides between two results. The renderer
# switches this off at every launch: both of its passes must take identical decisions.
FUSED = {"enable_fp_fusion": True}


def kernel(function: Callable) -> Callable:
    """Compile a function, without the wrapper of a type checker."""
    return triton.jit(inspect.unwrap(function))


@kernel
def tokens_at(position, length, REVERSE: tl.constexpr):
    """Return the indices (int64) of the tokens at scan positions, and which of them exist."""
    position = tl.cast(position, tl.int64)
    token = length - 1 - position if REVERSE else position
    return token, position < length
