"""The selective scan for CPUs (Numba): the states of 16 channels at a time.

A task divides a sequence into chunks of tokens and a chunk into blocks of 16 channels, the width of
a vector. It takes one of a block's N states at a time through the chunk, in a register. Only the
states at the start of each chunk are stored between the passes; the backward pass computes each
chunk's other states again.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import even_bounds, run_blocks
from asysplat.kernels.simd.vectors import LANES
from asysplat.ops.scan import ScanInputs
from asysplat.ops.selective_scan.cpu.kernels import (
    CACHE_CHUNK,
    BlockedGradients,
    BlockedInputs,
    backward_blocks,
    forward_blocks,
)

LOG2_E = 1 / math.log(2)


def saved_state_shape(x: Float[Tensor, "B L D"], B: Float[Tensor, "B L N"]) -> tuple:
    """Return the shape of the states at the start of chunks, [B, blocks, chunks, N, LANES]."""
    batch, length, channels = x.shape
    return batch, -(-channels // LANES), -(-length // CACHE_CHUNK), B.shape[-1], LANES


def forward(
    inputs: ScanInputs, reverse: bool, keep: bool
) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "_ _ _ _ _"]]:
    """Return y and the states at the start of chunks; see `asysplat.ops.scan`."""
    x = inputs.x
    y = torch.empty(x.shape, dtype=torch.float32)
    shape = saved_state_shape(x, inputs.B)
    saved_state = torch.empty(shape if keep else (0,) * len(shape))
    run_blocks(
        forward_blocks,
        even_bounds(shape[0] * shape[1]),
        _split_inputs(inputs, reverse),
        y.numpy(),
        saved_state.numpy(),
    )
    return y.to(x.dtype), saved_state


def backward(
    grad_output: Float[Tensor, "B L D"], inputs: ScanInputs, saved_state: Tensor, reverse: bool
) -> ScanInputs:
    """Return the gradients of the inputs; see `asysplat.ops.scan`."""
    x, _, _, B, C, _ = inputs
    batch, length, channels = x.shape
    blocks, state_size = saved_state.shape[1], B.shape[-1]
    grad_x, grad_dt = (torch.empty(x.shape, dtype=torch.float32) for _ in range(2))
    # The gradients of B and C are sums over all channels: each block writes its own part.
    part_B, part_C = (torch.empty(blocks, batch, length, state_size) for _ in range(2))
    grad_A = torch.empty(batch, blocks, state_size, LANES)
    grad_D = torch.empty(batch, blocks, 1, LANES)
    run_blocks(
        backward_blocks,
        even_bounds(batch * blocks),
        _split_inputs(inputs, reverse),
        saved_state.numpy(),
        _to_float32(grad_output).numpy(),
        BlockedGradients(
            *(part.numpy() for part in (grad_x, grad_dt, grad_A, part_B, part_C, grad_D))
        ),
    )
    return ScanInputs(
        x=grad_x.to(x.dtype),
        dt=grad_dt,
        A=_join_blocks(grad_A.sum(0))[:channels],
        B=part_B.sum(0).to(B.dtype),
        C=part_C.sum(0).to(C.dtype),
        D=_join_blocks(grad_D.sum(0))[:channels, 0],
    )


def _split_inputs(inputs: ScanInputs, reverse: bool) -> BlockedInputs:
    x, dt, B, C = map(_to_float32, (inputs.x, inputs.dt, inputs.B, inputs.C))
    return BlockedInputs(
        x=x.numpy(),
        dt=dt.numpy(),
        A=_split_blocks(inputs.A * LOG2_E).numpy(),
        B=B.numpy(),
        C=C.numpy(),
        D=_split_blocks(inputs.D[:, None]).numpy(),
        reverse=reverse,
    )


def _to_float32(tensor: Tensor) -> Tensor:
    return tensor.float().contiguous()


def _split_blocks(per_channel: Tensor) -> Tensor:
    """Rearrange [D, n] to [blocks of channels, n, LANES], where zeros fill the last block."""
    padded = F.pad(per_channel, (0, 0, 0, -len(per_channel) % LANES))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous()


def _join_blocks(per_block: Tensor) -> Tensor:
    """Rearrange [blocks of channels, n, LANES] to [blocks x LANES, n]."""
    return per_block.mT.flatten(0, 1)
