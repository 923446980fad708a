"""The selective scan for CPUs (Numba): a state of 16 channels at a time.

A task takes a sequence and 16 of its channels, one vector wide, and walks through chunks of tokens,
one of the N states after the other: it stays in a register meanwhile. Nothing is stored between the
passes but the state at the beginning of each chunk; the backward pass walks through a chunk once
more before it walks back.
"""

import math

import numpy as np
import torch
from torch import Tensor

from asysplat.ops.cpu.kernel import kernel
from asysplat.ops.cpu.lanes import ZERO, decay2
from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.ops.cpu.vectors import LANES, fma, load, store, total, zeros

CHUNK = 32  # tokens: what is kept of each, CHUNK x LANES, fits a core's nearest cache
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
    blocks, chunks, state_size = carried.shape[1:4]
    state = np.empty((state_size, LANES), np.float32)
    steps, added = np.zeros((CHUNK, LANES), np.float32), np.zeros((CHUNK, LANES), np.float32)
    out = np.empty((CHUNK, LANES), np.float32)
    for index in range(start, stop):
        batch, block = index // blocks, index % blocks
        first = block * LANES
        width = min(LANES, channels - first)
        rates = A[block]
        state[:] = ZERO
        steps[:] = ZERO
        added[:] = ZERO
        for chunk in range(chunks):
            carried[batch, block, chunk] = state
            begin = chunk * CHUNK
            count = min(CHUNK, length - begin)
            for k in range(count):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    steps[k, i] = dt[batch, t, first + i]
                    added[k, i] = steps[k, i] * x[batch, t, first + i]
            out[:] = ZERO
            for n in range(state_size):
                rate, value = load(rates, n), load(state, n)
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    decay = decay2(load(steps, k) * rate)
                    value = fma(decay, value, load(added, k) * B[batch, t, n])
                    store(out, k, fma(C[batch, t, n], value, load(out, k)))
                store(state, n, value)
            for k in range(count):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    y[batch, t, first + i] = fma(D[first + i], x[batch, t, first + i], out[k, i])


@kernel
def _backward(
    start, stop, x, dt, B, C, D, A, reverse, carried, grad_y,
    grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D,
):  # fmt: skip
    """Blocks start to stop of B x (blocks of channels); every element of the gradients' parts that
    belongs to them is written."""
    length, channels = x.shape[1:]
    blocks, chunks, state_size = carried.shape[1:4]
    steps, added = np.zeros((CHUNK, LANES), np.float32), np.zeros((CHUNK, LANES), np.float32)
    pull, decays = np.zeros((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    states = np.empty((CHUNK + 1, LANES), np.float32)
    g_steps, g_added = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    behind, chunk_D = np.empty((state_size, LANES), np.float32), np.empty(LANES, np.float32)
    for index in range(start, stop):
        batch, block = index // blocks, index % blocks
        first = block * LANES
        width = min(LANES, channels - first)
        rates, g_rates = A[block], grad_A[batch, block]
        behind[:] = ZERO
        g_rates[:] = ZERO
        grad_D[batch, block] = ZERO
        steps[:] = ZERO
        added[:] = ZERO
        pull[:] = ZERO
        for chunk in range(chunks - 1, -1, -1):
            begin = chunk * CHUNK
            count = min(CHUNK, length - begin)
            for k in range(count):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    steps[k, i] = dt[batch, t, first + i]
                    added[k, i] = steps[k, i] * x[batch, t, first + i]
                    pull[k, i] = grad_y[batch, t, first + i]
            g_steps[:] = ZERO
            g_added[:] = ZERO
            for n in range(state_size):
                rate, value = load(rates, n), load(carried[batch, block, chunk], n)
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    decay = decay2(load(steps, k) * rate)
                    store(decays, k, decay)
                    store(states, k, value)
                    value = fma(decay, value, load(added, k) * B[batch, t, n])
                store(states, count, value)
                later, g_rate = load(behind, n), zeros()
                for k in range(count - 1, -1, -1):
                    t = length - 1 - begin - k if reverse else begin + k
                    g_state = fma(C[batch, t, n], load(pull, k), later)
                    grad_B[block, batch, t, n] = total(g_state * load(added, k))
                    grad_C[block, batch, t, n] = total(load(pull, k) * load(states, k + 1))
                    store(g_added, k, fma(g_state, B[batch, t, n], load(g_added, k)))
                    later = g_state * load(decays, k)
                    # Of the exponent, a factor log2(e) is in A.
                    g_log = later * load(states, k)
                    store(g_steps, k, fma(g_log, rate, load(g_steps, k)))
                    g_rate = fma(g_log, load(steps, k), g_rate)
                store(behind, n, later)
                store(g_rates, n, load(g_rates, n) + g_rate)
            chunk_D[:] = ZERO
            for k in range(count):
                t = length - 1 - begin - k if reverse else begin + k
                for i in range(width):
                    value = x[batch, t, first + i]
                    grad_dt[batch, t, first + i] = fma(g_added[k, i], value, g_steps[k, i] * LN_2)
                    grad_x[batch, t, first + i] = fma(
                        D[first + i], pull[k, i], g_added[k, i] * steps[k, i]
                    )
                    chunk_D[i] = fma(pull[k, i], value, chunk_D[i])
            grad_D[batch, block] += chunk_D
