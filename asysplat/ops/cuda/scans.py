"""What the kernels of both scans share: where a token is, and the sizes they take.

Kernels count positions in the order of the scan; `reverse` is in the index of the token alone.
"""

import triton
import triton.language as tl

from asysplat.errors import InputError
from asysplat.ops.cuda.kernel import kernel

INTERPRETED = triton.knobs.runtime.interpret  # on a CPU, in NumPy: for tests
FUSED = {"enable_fp_fusion": True}  # nothing here decides between two results


@kernel
def tokens_at(position, length, REVERSE: tl.constexpr):
    """Return the indices (int64) of the tokens at these positions, and which of them exist."""
    position = tl.cast(position, tl.int64)
    token = length - 1 - position if REVERSE else position
    return token, position < length


def check_size(operator: str, name: str, size: int, most: int) -> None:
    """Raise InputError unless `size` is a power of two from 16 to `most`."""
    if size < 16 or size > most or size & (size - 1):
        raise InputError(
            f"{operator}'s backend 'cuda' got a {name} of {size}: expected a power of two from 16 "
            f"to {most}; change it, or choose backend 'chunked'."
        )
