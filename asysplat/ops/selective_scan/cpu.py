"""The selective scan for CPUs (Numba): the states of 16 channels stay in the cache.

A task takes a sequence and 16 of its channels, one vector wide, and walks through the tokens.
Nothing is stored between the passes but the state at the beginning of each chunk; the backward pass
walks through a chunk once more before it walks back.
"""

import math

import numpy as np
import torch
from torch import Tensor

from asysplat.ops.cpu.kernel import kernel
from asysplat.ops.cpu.lanes import LANES, ZERO, decay2, fma, take_sum
from asysplat.ops.cpu.threads import even_bounds, run_blocks

CHUNK = 32  # tokens: their states, CHUNK x N x LANES, fit a core's cache
LOG2_E, LN_2 = 1 / math.log(2), np.float32(math.log(2))


def carried_shape(x: Tensor, B: Tensor) -> tuple:
    """States at the beginning of chunks: [B, blocks of channels, chunks, N, LANES]."""
    batch, length, channels = x.shape
    return batch, -(-channels // LANES), -(-length // CHUNK), B.shape[-1], LANES


def forward(
    x: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, reverse: bool
) -> tuple[Tensor, Tensor]:
    """y, and what `backward` needs besides; see `asysplat.ops.selective_scan`."""
    y = torch.empty(x.shape, dtype=torch.float32)
    carried = torch.empty(carried_shape(x, B))
    arrays = _arrays(x, dt, B, C, D)
    run_blocks(
        _forward,
        even_bounds(carried.shape[0] * carried.shape[1]),
        *arrays,
        _by_block(A * LOG2_E),
        reverse,
        y.numpy(),
        carried.numpy(),
    )
    return y.to(x.dtype), carried


def backward(
    grad_y: Tensor,
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    carried: Tensor,
    reverse: bool,
) -> tuple[Tensor, ...]:
    """Gradients of x, dt, A, B, C and D."""
    batch, length, channels = x.shape
    blocks, state_size = carried.shape[1], B.shape[-1]
    grad_x, grad_dt = (torch.empty(x.shape, dtype=torch.float32) for _ in range(2))
    # Each block of channels has a place of its own for what is summed over channels.
    part_B, part_C = (torch.empty(blocks, batch, length, state_size) for _ in range(2))
    grad_A = torch.empty(batch, blocks, state_size, LANES)
    grad_D = torch.empty(batch, blocks, LANES)
    run_blocks(
        _backward,
        even_bounds(batch * blocks),
        *_arrays(x, dt, B, C, D),
        _by_block(A * LOG2_E),
        reverse,
        carried.numpy(),
        *_arrays(grad_y),
        grad_x.numpy(),
        grad_dt.numpy(),
        grad_A.numpy(),
        part_B.numpy(),
        part_C.numpy(),
        grad_D.numpy(),
    )
    return (
        grad_x.to(x.dtype),
        grad_dt,
        grad_A.sum(0).mT.flatten(0, 1)[:channels],
        part_B.sum(0).to(B.dtype),
        part_C.sum(0).to(C.dtype),
        grad_D.sum(0).flatten()[:channels],
    )


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().float().contiguous().numpy() for tensor in tensors]


def _by_block(A: Tensor) -> np.ndarray:
    """[D, N] -> [blocks of channels, N, LANES], zeros where there is no channel."""
    missing = -len(A) % LANES
    padded = torch.nn.functional.pad(A.detach().float(), (0, 0, 0, missing))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous().numpy()


@kernel
def _forward(start, stop, x, dt, B, C, D, A, reverse, y, carried):
    """Blocks start to stop of B x (blocks of channels)."""
    length, channels = x.shape[1:]
    blocks, state_size = carried.shape[1], carried.shape[3]
    state = np.empty((state_size, LANES), np.float32)
    step, out = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    added = np.empty(LANES, np.float32)
    for index in range(start, stop):
        batch, block = index // blocks, index % blocks
        first = block * LANES
        width = min(LANES, channels - first)
        state[:] = ZERO
        step[:] = ZERO
        added[:] = ZERO
        for k in range(length):
            t = length - 1 - k if reverse else k
            if k % CHUNK == 0:
                carried[batch, block, k // CHUNK] = state
            for i in range(width):
                step[i] = dt[batch, t, first + i]
                added[i] = step[i] * x[batch, t, first + i]
            out[:] = ZERO
            for n in range(state_size):
                b, c = B[batch, t, n], C[batch, t, n]
                for i in range(LANES):
                    decay = decay2(step[i] * A[block, n, i])
                    state[n, i] = fma(decay, state[n, i], added[i] * b)
                    out[i] = fma(c, state[n, i], out[i])
            for i in range(width):
                y[batch, t, first + i] = fma(D[first + i], x[batch, t, first + i], out[i])


@kernel
def _backward(
    start, stop, x, dt, B, C, D, A, reverse, carried, grad_y,
    grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D,
):  # fmt: skip
    """Blocks start to stop of B x (blocks of channels); every element of the gradients' parts that
    belongs to them is written."""
    length, channels = x.shape[1:]
    blocks, chunks, state_size = carried.shape[1:4]
    states = np.empty((CHUNK + 1, state_size, LANES), np.float32)
    decays = np.empty((CHUNK, state_size, LANES), np.float32)
    steps, added = np.zeros((CHUNK, LANES), np.float32), np.zeros((CHUNK, LANES), np.float32)
    pull, behind = np.zeros(LANES, np.float32), np.empty((state_size, LANES), np.float32)
    g_step, g_added = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    g_b, g_c = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    chunk_A, chunk_D = np.empty((state_size, LANES), np.float32), np.empty(LANES, np.float32)
    for index in range(start, stop):
        batch, block = index // blocks, index % blocks
        first = block * LANES
        width = min(LANES, channels - first)
        behind[:] = ZERO
        grad_A[batch, block] = ZERO
        grad_D[batch, block] = ZERO
        steps[:] = ZERO
        added[:] = ZERO
        pull[:] = ZERO
        for chunk in range(chunks - 1, -1, -1):
            chunk_A[:] = ZERO
            chunk_D[:] = ZERO
            begin = chunk * CHUNK
            count = min(CHUNK, length - begin)
            states[0] = carried[batch, block, chunk]
            for k in range(count):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    steps[k, i] = dt[batch, t, first + i]
                    added[k, i] = steps[k, i] * x[batch, t, first + i]
                for n in range(state_size):
                    b = B[batch, t, n]
                    for i in range(LANES):
                        decay = decay2(steps[k, i] * A[block, n, i])
                        decays[k, n, i] = decay
                        states[k + 1, n, i] = fma(decay, states[k, n, i], added[k, i] * b)
            for k in range(count - 1, -1, -1):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    pull[i] = grad_y[batch, t, first + i]
                g_step[:] = ZERO
                g_added[:] = ZERO
                for n in range(state_size):
                    b, c = B[batch, t, n], C[batch, t, n]
                    for i in range(LANES):
                        g_state = fma(c, pull[i], behind[n, i])
                        g_c[i] = pull[i] * states[k + 1, n, i]
                        g_b[i] = g_state * added[k, i]
                        g_added[i] = fma(g_state, b, g_added[i])
                        # Of the exponent, a factor log2(e) is in A.
                        g_log = g_state * decays[k, n, i] * states[k, n, i]
                        g_step[i] = fma(g_log, A[block, n, i], g_step[i])
                        chunk_A[n, i] += g_log * steps[k, i]
                        behind[n, i] = g_state * decays[k, n, i]
                    grad_B[block, batch, t, n] = take_sum(g_b, 0)
                    grad_C[block, batch, t, n] = take_sum(g_c, 0)
                for i in range(width):
                    value = x[batch, t, first + i]
                    grad_dt[batch, t, first + i] = fma(g_added[i], value, g_step[i] * LN_2)
                    grad_x[batch, t, first + i] = fma(
                        D[first + i], pull[i], g_added[i] * steps[k, i]
                    )
                    chunk_D[i] = fma(pull[i], value, chunk_D[i])
            grad_A[batch, block] += chunk_A
            grad_D[batch, block] += chunk_D
