"""The selective scan by its formula, token by token."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.scan import ScanInputs


def selective_scan_reference(inputs: ScanInputs) -> Float[Tensor, "B L D"]:
    """Scan by the formula; see `asysplat.ops.selective_scan`."""
    x, dt, A, B, C, D = inputs
    state = x.new_zeros(x.shape[0], *A.shape)
    outputs = []
    for t in range(x.shape[1]):
        decay = torch.exp(dt[:, t, :, None] * A)
        state = decay * state + (dt[:, t] * x[:, t])[..., None] * B[:, t, None, :]
        outputs.append(torch.einsum("bdn,bn->bd", state, C[:, t]) + D * x[:, t])
    return torch.stack(outputs, dim=1)
