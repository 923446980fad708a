"""A step of Adam (Kingma and Ba 2015) for those rows of tensors that have a gradient."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference


@torch.no_grad()
def adam_step(tensors: Sequence[Rows], seen: Bool[Tensor, "N"], settings: AdamSettings) -> int:
    """Update the rows that were seen, in place: float32 on a CPU by a kernel, else by torch.

    A row that was not seen, or whose gradient is not finite in all of the tensors, stays as it is
    in all of them, and so does what is known of it.

    Returns:
        How many rows were seen and have a gradient that is not finite.
    """
    if all(rows.parameter.dtype == torch.float32 and rows.parameter.is_cpu for rows in tensors):
        from asysplat.ops.adam.cpu import adam_step_cpu

        return adam_step_cpu(tensors, seen, settings)
    return adam_step_reference(tensors, seen, settings)
