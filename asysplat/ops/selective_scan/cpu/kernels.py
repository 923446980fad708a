"""The kernels: a task takes its blocks of LANES channels through a sequence, chunk by chunk."""

import math
from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.threads import inline, kernel
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

CACHE_CHUNK = 32  # tokens of a chunk, whose arrays of CACHE_CHUNK x LANES fit into the L1 cache
ROWS = (CACHE_CHUNK, LANES)
LN_2 = np.float32(math.log(2))


class BlockedInputs(NamedTuple):
    """The inputs of a scan in float32; zeros fill the last block of channels."""

    x: np.ndarray  # [B, L, D]
    dt: np.ndarray  # [B, L, D]
    A: np.ndarray  # [blocks, N, LANES], multiplied by log2(e), for decays as powers of 2
    B: np.ndarray  # [B, L, N]
    C: np.ndarray  # [B, L, N]
    D: np.ndarray  # [blocks, 1, LANES]
    reverse: bool  # from the last token to the first


class BlockedGradients(NamedTuple):
    """The gradients of the inputs, to be summed: B and C over blocks, A and D over sequences."""

    x: np.ndarray  # [B, L, D]
    dt: np.ndarray  # [B, L, D]
    A: np.ndarray  # [B, blocks, N, LANES]
    B: np.ndarray  # [blocks, B, L, N]
    C: np.ndarray  # [blocks, B, L, N]
    D: np.ndarray  # [B, blocks, 1, LANES]


@inline
def token_at(position, length, reverse):
    """Return the index of the token at a position of the scan."""
    return length - 1 - position if reverse else position


@kernel
def forward_blocks(start, stop, inputs, y, saved_state):
    """Write y [B, L, D] of the blocks start to stop, counted over [B, blocks of channels].

    Unless it is empty, `saved_state` [B, blocks, chunks, N, LANES] receives the states at the start
    of each chunk.
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


@kernel
def backward_blocks(start, stop, inputs, saved_state, grad_output, grads):
    """Write the gradients of the same blocks as `forward_blocks`, last chunk first."""
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
