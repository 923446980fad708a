"""The forward pass: a task takes its blocks of channels through a sequence, chunk by chunk."""

import numpy as np

from asysplat.kernels.simd.threads import kernel
from asysplat.kernels.simd.vectors import (
    LANES,
    ZERO,
    decay2,
    fma,
    load,
    load_some,
    store,
    store_some,
)
from asysplat.ops.selective_scan.cpu.chunk import CACHE_CHUNK, ROWS, token_at


@kernel
def forward_blocks(start, stop, inputs, y, saved_state):
    """Write y of the blocks start to stop, counted over [B, blocks of channels].

    Args:
        inputs: see `BlockedInputs`.
        y: [B, L, D], written.
        saved_state: [B, blocks, chunks, N, LANES] states at the start of each chunk, written; or
            empty.
    """
    x, dt, A, B, C, D, reverse = inputs
    length, channels = x.shape[1:]
    blocks, state_size = A.shape[:2]
    chunks = -(-length // CACHE_CHUNK)
    states = np.empty((blocks, state_size, LANES), np.float32)
    values, out = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
    steps, added = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
    while start < stop:
        batch, first_block = start // blocks, start % blocks
        last_block = min(blocks, first_block + stop - start)
        start += last_block - first_block
        states[:] = ZERO
        for chunk in range(chunks):
            begin = chunk * CACHE_CHUNK
            count = min(CACHE_CHUNK, length - begin)
            for block in range(first_block, last_block):
                state, rates = states[block], A[block]
                if len(saved_state):
                    saved_state[batch, block, chunk] = state
                first = block * LANES
                width = min(LANES, channels - first)
                for k in range(count):
                    t = token_at(begin + k, length, reverse)
                    place = (batch * length + t) * channels + first
                    step, value = load_some(dt, place, width), load_some(x, place, width)
                    store(steps, k, step)
                    store(values, k, value)
                    store(added, k, step * value)
                out[:] = ZERO
                for n in range(state_size):
                    rate, value = load(rates, n), load(state, n)
                    for k in range(count):
                        t = token_at(begin + k, length, reverse)
                        decay = decay2(load(steps, k) * rate)
                        value = fma(decay, value, load(added, k) * B[batch, t, n])
                        store(out, k, fma(C[batch, t, n], value, load(out, k)))
                    store(state, n, value)
                skip = load(D[block], 0)
                for k in range(count):
                    t = token_at(begin + k, length, reverse)
                    place = (batch * length + t) * channels + first
                    store_some(y, place, width, fma(skip, load(values, k), load(out, k)))
