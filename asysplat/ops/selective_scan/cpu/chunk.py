"""The arrays of a task: chunks of a sequence, and blocks of LANES channels."""

from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from asysplat.kernels.simd.vectors import LANES

CACHE_CHUNK = 32  # tokens: arrays of CACHE_CHUNK x LANES fit a core's first cache
ROWS = (CACHE_CHUNK, LANES)


class BlockedInputs(NamedTuple):
    """The inputs of a scan in float32; zeros fill up the last block of channels.

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
    """The gradients: of B and C for each block, of A and D for each sequence.

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
    """Rearrange [D, n] to [blocks of channels, n, LANES], filled up with zeros."""
    padded = F.pad(per_channel, (0, 0, 0, -len(per_channel) % LANES))
    return padded.unflatten(0, (-1, LANES)).mT.contiguous()


def by_channel(per_block: Tensor) -> Tensor:
    """Rearrange [blocks of channels, n, LANES] to [D, n], with the last block's padding."""
    return per_block.mT.flatten(0, 1)
