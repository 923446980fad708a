"""The arrays of a task: chunks of a sequence, and blocks of LANES channels."""

from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from asysplat.kernels.simd.threads import inline
from asysplat.kernels.simd.vectors import LANES

CACHE_CHUNK = 32  # tokens of a chunk, whose arrays of CACHE_CHUNK x LANES fit into the L1 cache
ROWS = (CACHE_CHUNK, LANES)


class BlockedInputs(NamedTuple):
    """The inputs of a scan in float32; zeros fill the last block of channels.

    Args:
        x, dt: [B, L, D].
        A: [blocks, N, LANES], multiplied by log2(e), for decays as powers of 2.
        B, C: [B, L, N].
        D: [blocks, 1, LANES].
        reverse: True if the scan goes from the last token to the first.
    """

    x: np.ndarray
    dt: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    reverse: bool


class BlockedGradients(NamedTuple):
    """The gradients of the inputs, to be summed: B and C over blocks, A and D over sequences.

    Args:
        x, dt: [B, L, D].
        A: [B, blocks, N, LANES].
        B, C: [blocks, B, L, N].
        D: [B, blocks, 1, LANES].
    """

    x: np.ndarray
    dt: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


@inline
def token_at(position, length, reverse):
    """Return the index of the token at a position of the scan."""
    return length - 1 - position if reverse else position


def split_blocks(per_channel: Tensor) -> Tensor:
    """Rearrange [D, n] to [blocks of channels, n, LANES], where zeros fill the last block."""
    padded = F.pad(per_channel, (0, 0, 0, -len(per_channel) % LANES))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous()


def join_blocks(per_block: Tensor) -> Tensor:
    """Rearrange [blocks of channels, n, LANES] to [blocks x LANES, n]."""
    return per_block.mT.flatten(0, 1)
