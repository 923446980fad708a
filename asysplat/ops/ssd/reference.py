"""The SSD recurrence by its formula, token by token."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.scan import ScanInputs


def ssd_reference(inputs: ScanInputs) -> Float[Tensor, "B L H P"]:
    """Scan by the formula; see `asysplat.ops.ssd`."""
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
