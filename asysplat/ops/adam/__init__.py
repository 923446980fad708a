"""A step of Adam (Kingma and Ba 2015) that updates some rows of tensors."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from asysplat.kernels.dispatch import choose_fastest
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference


@torch.no_grad()
def adam_step(
    tensors: Sequence[Rows], visible: Bool[Tensor, "N"], settings: AdamSettings
) -> int | Int[Tensor, ""]:
    """Update the visible rows in place, float32 by the kernels of its device, else by torch.

    A row with a non-finite gradient in any of the tensors is updated in none of them; the number of
    such visible rows is returned, by a GPU's kernels as a tensor, for which nobody waits.
    """
    check = "asysplat.ops.self_check:adam"
    backends = {choose_fastest(rows.parameter, "reference", check) for rows in tensors}
    if backends == {"cpu"}:
        from asysplat.ops.adam.cpu import adam_step_cpu

        return adam_step_cpu(tensors, visible, settings)
    if backends == {"cuda"}:
        from asysplat.ops.adam.cuda import adam_step_cuda

        return adam_step_cuda(tensors, visible, settings)
    return adam_step_reference(tensors, visible, settings)
