"""SSD in torch, for any device and float type: by its formula, and in chunks."""

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.scan import ScanInputs, linear_recurrence

CHUNK = 64  # tokens of a chunk on every backend; the FLOP counts depend on it


def ssd_reference(inputs: ScanInputs) -> Float[Tensor, "B L H P"]:
    """Scan token by token; see `asysplat.ops.ssd`."""
    x, dt, A, B, C, D = inputs
    batch, length, heads, head_dim = x.shape
    state = x.new_zeros(batch, heads, head_dim, B.shape[-1])
    outputs = []
    for t in range(length):
        decay = torch.exp(dt[:, t] * A)[..., None, None]
        new = torch.einsum("bh,bhp,bn->bhpn", dt[:, t], x[:, t], B[:, t])
        state = decay * state + new
        outputs.append(torch.einsum("bhpn,bn->bhp", state, C[:, t]) + D[:, None] * x[:, t])
    return torch.stack(outputs, dim=1)


def ssd_chunked(inputs: ScanInputs) -> Float[Tensor, "B L H P"]:
    """Scan by matrix products within chunks and a short recurrence between them.

    Dao and Gu 2024, Section 6. Decays stay in the log domain and every exponent is <= 0.
    """
    x, dt, A, B, C, D = inputs
    length = x.shape[1]
    skip = D[:, None] * x
    # Padded tokens have dt = 0: they neither decay the state nor add to it.
    x, dt, B, C = (_into_chunks(tensor) for tensor in (x, dt, B, C))
    exponents = dt * A
    log_decay = torch.cumsum(exponents, dim=2)  # [b c q h], since the chunk's start
    scaled = x * dt[..., None]

    scores = (C @ B.mT)[..., None] * _decay_between(exponents)  # [b c t s h]
    y = torch.einsum("bctsh,bcshp->bcthp", scores, scaled)

    if x.shape[1] > 1:
        to_end = torch.exp(F.pad(exponents[:, :, 1:], (0, 0, 0, 1)).flip(2).cumsum(2).flip(2))
        added = torch.einsum("bcsn,bcsh,bcshp->cbhpn", B, to_end, scaled)
        decay = rearrange(torch.exp(log_decay[:, :, -1]), "b c h -> c b h 1 1")
        states = linear_recurrence(decay.expand_as(added), added)
        before = F.pad(states[:-1], (0, 0, 0, 0, 0, 0, 0, 0, 1, 0))
        from_before = torch.einsum("bctn,cbhpn->bcthp", C, before)
        y = y + from_before * torch.exp(log_decay)[..., None]
    return rearrange(y, "b c q h p -> b (c q) h p")[:, :length] + skip


def _into_chunks(tensor: Tensor) -> Tensor:
    """Cut [b L ...] into [b c CHUNK ...], padded with zeros at the end."""
    missing = -tensor.shape[1] % CHUNK
    if missing:
        tensor = F.pad(tensor, (0, 0) * (tensor.ndim - 2) + (0, missing))
    return tensor.unflatten(1, (-1, CHUNK))


def _decay_between(exponents: Float[Tensor, "b c q h"]) -> Float[Tensor, "b c q q h"]:
    """Return [b c t s h], exp of the sum of exponents after token s up to t; 0 where s > t.

    Each exponent is summed directly: in a difference of two sums from the chunk's start, a huge
    step would leave its rounding error.
    """
    q = exponents.shape[2]
    ones = torch.ones(q, q, dtype=torch.bool, device=exponents.device)
    steps = exponents[:, :, :, None].expand(-1, -1, -1, q, -1)  # [b c t s h]
    sums = steps.masked_fill(ones.triu()[..., None], 0).cumsum(2)
    return torch.exp(sums.masked_fill(ones.triu(1)[..., None], -torch.inf))
