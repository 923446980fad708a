"""The backward pass: a task takes its blocks of channels through a sequence, last chunk first."""

import math

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
    total,
    zeros,
)
from asysplat.ops.selective_scan.cpu.chunk import CACHE_CHUNK, ROWS, token_at

LN_2 = np.float32(math.log(2))


@kernel
def backward_blocks(start, stop, inputs, saved_state, grad_output, grads):
    """Write the gradients of the blocks start to stop, counted over [B, blocks of channels].

    Args:
        inputs, grads: see `BlockedInputs` and `BlockedGradients`.
        saved_state: written by `forward_blocks`.
        grad_output: [B, L, D].
    """
    x, dt, A, B, C, D, reverse = inputs
    grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D = grads
    length, channels = x.shape[1:]
    blocks, chunks, state_size = saved_state.shape[1:4]
    values, outs = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
    steps, added = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
    decays = np.empty(ROWS, np.float32)
    states = np.empty((CACHE_CHUNK + 1, LANES), np.float32)
    g_steps, g_added = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
    # Gradients of the states before a chunk
    g_states = np.empty((blocks, state_size, LANES), np.float32)
    while start < stop:
        batch, first_block = start // blocks, start % blocks
        last_block = min(blocks, first_block + stop - start)
        start += last_block - first_block
        g_states[:] = ZERO
        grad_A[batch, first_block:last_block] = ZERO
        grad_D[batch, first_block:last_block] = ZERO
        for chunk in range(chunks - 1, -1, -1):
            begin = chunk * CACHE_CHUNK
            count = min(CACHE_CHUNK, length - begin)
            for block in range(first_block, last_block):
                rates, g_rates = A[block], grad_A[batch, block]
                first = block * LANES
                width = min(LANES, channels - first)
                for k in range(count):
                    t = token_at(begin + k, length, reverse)
                    place = (batch * length + t) * channels + first
                    step, value = load_some(dt, place, width), load_some(x, place, width)
                    store(steps, k, step)
                    store(values, k, value)
                    store(added, k, step * value)
                    store(outs, k, load_some(grad_output, place, width))
                g_steps[:] = ZERO
                g_added[:] = ZERO
                for n in range(state_size):
                    rate, value = load(rates, n), load(saved_state[batch, block, chunk], n)
                    for k in range(count):
                        t = token_at(begin + k, length, reverse)
                        decay = decay2(load(steps, k) * rate)
                        store(decays, k, decay)
                        store(states, k, value)
                        value = fma(decay, value, load(added, k) * B[batch, t, n])
                    store(states, count, value)
                    later, g_rate = load(g_states[block], n), zeros()
                    for k in range(count - 1, -1, -1):
                        t = token_at(begin + k, length, reverse)
                        g_state = fma(C[batch, t, n], load(outs, k), later)
                        grad_B[block, batch, t, n] = total(g_state * load(added, k))
                        grad_C[block, batch, t, n] = total(load(outs, k) * load(states, k + 1))
                        store(g_added, k, fma(g_state, B[batch, t, n], load(g_added, k)))
                        later = g_state * load(decays, k)
                        # `rate` has the factor log2(e), which LN_2 removes from g_steps below.
                        g_log = later * load(states, k)
                        store(g_steps, k, fma(g_log, rate, load(g_steps, k)))
                        g_rate = fma(g_log, load(steps, k), g_rate)
                    store(g_states[block], n, later)
                    store(g_rates, n, load(g_rates, n) + g_rate)
                skip, g_skip = load(D[block], 0), zeros()
                for k in range(count):
                    t = token_at(begin + k, length, reverse)
                    place = (batch * length + t) * channels + first
                    g_input, value = load(g_added, k), load(values, k)
                    g_step = fma(g_input, value, load(g_steps, k) * LN_2)
                    g_value = fma(skip, load(outs, k), g_input * load(steps, k))
                    store_some(grad_dt, place, width, g_step)
                    store_some(grad_x, place, width, g_value)
                    g_skip = fma(load(outs, k), value, g_skip)
                store(grad_D[batch, block], 0, load(grad_D[batch, block], 0) + g_skip)
