"""The gradient of a splat from those of its tiles."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering.cuda.splat import GRADIENT

PAIRS = tl.constexpr(8)  # of a splat that are summed at a time


@kernel
def sum_pairs(counts, first_pair, grads, num_splats, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """Leave the sum over each of BLOCK splats' tiles, in a fixed order, in the place of its first
    pair.

    Args:
        counts, first_pair: [num_splats].
        grads: [pairs, 10], of which the first CHANNELS are summed.
    """
    d = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(counts + d, mask=d < num_splats, other=0)
    several = count > 1
    most = tl.max(tl.where(several, count, 0), 0)
    if most > 0:
        row = grads + GRADIENT * tl.load(first_pair + d, mask=several, other=0).to(tl.int64)
        step = tl.arange(0, PAIRS)
        for channel in tl.static_range(CHANNELS):
            total = tl.zeros((BLOCK,), tl.float64)
            for start in range(0, most, PAIRS):
                pair = start + step[None, :]
                here = several[:, None] & (pair < count[:, None])
                values = tl.load(row[:, None] + GRADIENT * pair + channel, mask=here, other=0.0)
                total += tl.sum(values.to(tl.float64), 1)
            tl.store(row + channel, total.to(tl.float32), mask=several)
