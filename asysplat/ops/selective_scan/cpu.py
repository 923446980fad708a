"""The selective scan for CPUs (Numba): a state of 16 channels at a time.

A task walks through a sequence by chunks of tokens, and through a chunk by blocks of 16 channels,
one vector wide, one of the N states after the other: it stays in a register meanwhile. Nothing is
stored between the passes but the state at the beginning of each chunk; the backward pass walks
through a chunk once more before it walks back.
"""

import math

import numpy as np
import torch
from torch import Tensor

from asysplat.ops.cpu.kernel import kernel
from asysplat.ops.cpu.lanes import ZERO, decay2
from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.ops.cpu.vectors import LANES, fma, load, load_some, store, store_some, total, zeros

CHUNK = 32  # tokens: what is kept of each, CHUNK x LANES, fits a core's nearest cache
LOG2_E, LN_2 = 1 / math.log(2), np.float32(math.log(2))


def carried_shape(x: Tensor, B: Tensor) -> tuple:
    """States at the beginning of chunks: [B, blocks of channels, chunks, N, LANES]."""
    batch, length, channels = x.shape
    return batch, -(-channels // LANES), -(-length // CHUNK), B.shape[-1], LANES


def forward(
    x: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, reverse: bool, keep: bool
) -> tuple[Tensor, Tensor]:
    """y, and what `backward` needs besides if that is to be kept.

    See `asysplat.ops.selective_scan`.
    """
    y = torch.empty(x.shape, dtype=torch.float32)
    shape = carried_shape(x, B)
    carried = torch.empty(shape if keep else (0,) * len(shape))
    run_blocks(
        _forward,
        even_bounds(shape[0] * shape[1]),
        *_arrays(x, dt, B, C),
        _by_block(A * LOG2_E),
        _by_block(D[:, None]),
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
    grad_D = torch.empty(batch, blocks, 1, LANES)
    run_blocks(
        _backward,
        even_bounds(batch * blocks),
        *_arrays(x, dt, B, C),
        _by_block(A * LOG2_E),
        _by_block(D[:, None]),
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
        _by_channel(grad_A.sum(0))[:channels],
        part_B.sum(0).to(B.dtype),
        part_C.sum(0).to(C.dtype),
        _by_channel(grad_D.sum(0))[:channels, 0],
    )


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().float().contiguous().numpy() for tensor in tensors]


def _by_block(per_channel: Tensor) -> np.ndarray:
    """[D, n] -> [blocks of channels, n, LANES], zeros where there is no channel."""
    missing = -len(per_channel) % LANES
    padded = torch.nn.functional.pad(per_channel.detach().float(), (0, 0, 0, missing))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous().numpy()


def _by_channel(by_block: Tensor) -> Tensor:
    """[blocks of channels, n, LANES] -> [D, n], and some where there is no channel."""
    return by_block.mT.flatten(0, 1)


@kernel
def _forward(start, stop, x, dt, B, C, A, D, reverse, y, carried):
    """Blocks start to stop of B x (blocks of channels)."""
    length, channels = x.shape[1:]
    blocks, state_size = A.shape[:2]
    chunks = -(-length // CHUNK)
    states = np.empty((blocks, state_size, LANES), np.float32)
    values, out = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    steps, added = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    while start < stop:
        batch, first_block = start // blocks, start % blocks
        last_block = min(blocks, first_block + stop - start)
        start += last_block - first_block
        states[:] = ZERO
        for chunk in range(chunks):
            begin = chunk * CHUNK
            count = min(CHUNK, length - begin)
            for block in range(first_block, last_block):
                state, rates = states[block], A[block]
                if len(carried):
                    carried[batch, block, chunk] = state
                first = block * LANES
                width = min(LANES, channels - first)
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    place = (batch * length + t) * channels + first
                    step, value = load_some(dt, place, width), load_some(x, place, width)
                    store(steps, k, step)
                    store(values, k, value)
                    store(added, k, step * value)
                out[:] = ZERO
                for n in range(state_size):
                    rate, value = load(rates, n), load(state, n)
                    for k in range(count):
                        t = length - 1 - begin - k if reverse else begin + k
                        decay = decay2(load(steps, k) * rate)
                        value = fma(decay, value, load(added, k) * B[batch, t, n])
                        store(out, k, fma(C[batch, t, n], value, load(out, k)))
                    store(state, n, value)
                skip = load(D[block], 0)
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    place = (batch * length + t) * channels + first
                    store_some(y, place, width, fma(skip, load(values, k), load(out, k)))


@kernel
def _backward(
    start, stop, x, dt, B, C, A, D, reverse, carried, grad_y,
    grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D,
):  # fmt: skip
    """Blocks start to stop of B x (blocks of channels); every element of the gradients' parts that
    belongs to them is written."""
    length, channels = x.shape[1:]
    blocks, chunks, state_size = carried.shape[1:4]
    values, pull = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    steps, added = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    decays = np.empty((CHUNK, LANES), np.float32)
    states = np.empty((CHUNK + 1, LANES), np.float32)
    g_steps, g_added = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    behind = np.empty((blocks, state_size, LANES), np.float32)
    while start < stop:
        batch, first_block = start // blocks, start % blocks
        last_block = min(blocks, first_block + stop - start)
        start += last_block - first_block
        behind[:] = ZERO
        grad_A[batch, first_block:last_block] = ZERO
        grad_D[batch, first_block:last_block] = ZERO
        for chunk in range(chunks - 1, -1, -1):
            begin = chunk * CHUNK
            count = min(CHUNK, length - begin)
            for block in range(first_block, last_block):
                rates, g_rates = A[block], grad_A[batch, block]
                first = block * LANES
                width = min(LANES, channels - first)
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    place = (batch * length + t) * channels + first
                    step, value = load_some(dt, place, width), load_some(x, place, width)
                    store(steps, k, step)
                    store(values, k, value)
                    store(added, k, step * value)
                    store(pull, k, load_some(grad_y, place, width))
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
                    later, g_rate = load(behind[block], n), zeros()
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
                    store(behind[block], n, later)
                    store(g_rates, n, load(g_rates, n) + g_rate)
                skip, g_skip = load(D[block], 0), zeros()
                for k in range(count):
                    t = length - 1 - begin - k if reverse else begin + k
                    place = (batch * length + t) * channels + first
                    g_input, value = load(g_added, k), load(values, k)
                    g_step = fma(g_input, value, load(g_steps, k) * LN_2)
                    g_value = fma(skip, load(pull, k), g_input * load(steps, k))
                    store_some(grad_dt, place, width, g_step)
                    store_some(grad_x, place, width, g_value)
                    g_skip = fma(load(pull, k), value, g_skip)
                store(grad_D[batch, block], 0, load(grad_D[batch, block], 0) + g_skip)
