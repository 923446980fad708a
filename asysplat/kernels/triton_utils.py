"""Helpers of the GPU kernels (Triton): compilation, and the tokens at positions of a scan."""

import inspect
from collections.abc import Callable

import triton
import triton.language as tl

INTERPRETED = triton.knobs.runtime.interpret  # True in tests on a CPU, where NumPy runs the kernels
# Launch option: a product and a sum may become one fused multiply-add. The renderer forbids it, as
# its two passes must round alike to take the same decisions; no operator's kernels depend on that.
FUSED = {"enable_fp_fusion": True}
# Sizes that change within a run, as Gaussians are added and views are selected. Triton would
# compile a kernel again whenever one becomes 1, a multiple of 16 or neither.
CHANGING = {"num", "num_visible", "num_splats", "views", "first", "length", "chunks"}
CHANGING |= {"room", "first_tile", "end_tile"}


def kernel(function: Callable) -> Callable:
    """Compile a function as a kernel, once for all values of CHANGING."""
    function = inspect.unwrap(function)  # without a type checker's wrapper
    changing = [name for name in inspect.signature(function).parameters if name in CHANGING]
    return triton.jit(function, do_not_specialize=changing)


@kernel
def tokens_at(position, length, REVERSE: tl.constexpr):
    """Return the indices (int64) of the tokens at positions of a scan, and which of them exist."""
    position = tl.cast(position, tl.int64)
    token = length - 1 - position if REVERSE else position
    return token, position < length
