"""The selective scan in torch, for any device and float type: by its formula, and in chunks."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from asysplat.ops.scan import ScanInputs, linear_recurrence

CHECKPOINT_CHUNK = 256  # tokens whose states are in memory at once


def selective_scan_reference(inputs: ScanInputs) -> Float[Tensor, "B L D"]:
    """Scan token by token; see `asysplat.ops.selective_scan`."""
    x, dt, A, B, C, D = inputs
    state = x.new_zeros(x.shape[0], *A.shape)
    outputs = []
    for t in range(x.shape[1]):
        decay = torch.exp(dt[:, t, :, None] * A)
        state = decay * state + (dt[:, t] * x[:, t])[..., None] * B[:, t, None, :]
        outputs.append(torch.einsum("bdn,bn->bd", state, C[:, t]) + D * x[:, t])
    return torch.stack(outputs, dim=1)


def selective_scan_chunked(inputs: ScanInputs) -> Float[Tensor, "B L D"]:
    """Scan a chunk of tokens at a time, of which only the recurrence is sequential.

    The backward pass computes each chunk again: the states of only one chunk are in memory.
    """
    x, dt, A, B, C, D = inputs
    state = x.new_zeros(x.shape[0], *A.shape)
    outputs = []
    for chunk in zip(
        *(tensor.split(CHECKPOINT_CHUNK, dim=1) for tensor in (x, dt, B, C)), strict=True
    ):
        y, state = checkpoint(_scan_chunk, *chunk, A, D, state, use_reentrant=False)
        outputs.append(y)
    return torch.cat(outputs, 1)


def _scan_chunk(
    x: Tensor, dt: Tensor, B: Tensor, C: Tensor, A: Tensor, D: Tensor, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Return y of a chunk, and the state after it."""
    # Time comes first, so that each step of the recurrence reads contiguous memory.
    xs, dts, Bs, Cs = (tensor.transpose(0, 1) for tensor in (x, dt, B, C))
    decay = torch.exp(dts[..., None] * A)
    inputs = (dts * xs)[..., None] * Bs[..., None, :]
    first = torch.addcmul(inputs[0], decay[0], state)
    states = linear_recurrence(decay, torch.cat((first[None], inputs[1:])))
    y = (states @ Cs[..., None]).squeeze(-1)
    return torch.addcmul(y, xs, D).transpose(0, 1), states[-1]
