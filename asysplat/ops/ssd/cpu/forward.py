"""The output of a segment: each head goes through its chunks.

A state is [N, width], where `width` is the head_dim in whole vectors of LANES; arrays with a row
for each token have the same width. The columns beyond the head_dim stay 0.
"""

import numpy as np

from asysplat.kernels.simd.products import add_product, add_triangle
from asysplat.kernels.simd.threads import kernel
from asysplat.kernels.simd.vectors import ZERO, fma
from asysplat.ops.ssd.cpu.chunk import scale_rows, take_rows, weigh_scores


@kernel
def forward_heads(start, stop, segment, states, y):
    """Write y of the heads start to stop, and update their states.

    Args:
        segment: see `Segment`.
        states: [h, N, width] states before the segment, overwritten by those after it.
        y: [l, h, p].
    """
    x, dt, B, C, D = segment.x, segment.dt, segment.B, segment.C, segment.D
    scores, decays, reverse = segment.scores, segment.decays, segment.reverse
    chunks, size, _ = B.shape
    head_dim, width = x.shape[2], states.shape[2]
    inputs, out = np.zeros((size, width), np.float32), np.zeros((size, width), np.float32)
    weights = np.zeros((size, size), np.float32)
    for head in range(start, stop):
        for k in range(chunks):
            chunk = chunks - 1 - k if reverse else k
            begin = chunk * size
            high, low = decays.high[chunk, head], decays.low[chunk, head]
            take_rows(x, begin, head, inputs)
            scale_rows(inputs, dt[begin : begin + size, head])
            weigh_scores(scores[chunk], high, low, reverse, weights)
            add_product(out, C[chunk], states[head], ZERO)
            scale_rows(out, decays.from_start[chunk, head])
            add_triangle(out, weights, inputs, reverse)
            for t in range(size):
                for i in range(head_dim):
                    y[begin + t, head, i] = fma(D[head], x[begin + t, head, i], out[t, i])
            scale_rows(inputs, decays.to_end[chunk, head])
            add_product(states[head], B[chunk].T, inputs, decays.across[chunk, head])
