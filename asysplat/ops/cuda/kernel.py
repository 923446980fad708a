"""How every kernel for GPUs is compiled.

Products and sums that decide what a pixel shows are fused by name and never by the compiler's
choice (enable_fp_fusion=False at every launch of the renderer), so that both passes take identical
decisions.
"""

import inspect
from collections.abc import Callable

import triton


def kernel(function: Callable) -> Callable:
    """Compile a function, without what a type checker has put around it."""
    return triton.jit(inspect.unwrap(function))
