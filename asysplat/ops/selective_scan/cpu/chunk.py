"""What a task works on: chunks of a sequence, and blocks of as many channels as a vector has."""

from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from asysplat.ops.simd.vectors import LANES

CACHE_CHUNK = 32  # tokens: what is kept of each, CACHE_CHUNK x LANES, fits a core's nearest cache
ROWS = (CACHE_CHUNK, LANES)


class BlockedInputs(NamedTuple):
    """The inputs of a scan in float32, with zeros where the last block has no channel.

    Args:
        x, dt: [B, L, D].
        A: [blocks, N, LANES], times log2(e).
        B, C: [B, L, N].
        D: [blocks, 1, LANES].
        reverse: the scan goes from the last token to the first.
    """

    x: np.ndarray
    dt: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    reverse: bool


class BlockedGradients(NamedTuple):
    """Their gradients, those of B and C for each block and those of A and D for each sequence.

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


def by_block(per_channel: Tensor) -> Tensor:
    """Rearrange [D, n] to [blocks of channels, n, LANES], zeros where there is no channel."""
    padded = F.pad(per_channel, (0, 0, 0, -len(per_channel) % LANES))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous()


def by_channel(per_block: Tensor) -> Tensor:
    """Rearrange [blocks of channels, n, LANES] to [D, n], and rows where there is no channel."""
    return per_block.mT.flatten(0, 1)
