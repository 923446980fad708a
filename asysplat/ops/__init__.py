"""The operators in which training and reconstruction spend most of their time.

An operator with kernels is a folder. `reference.py` computes the formula in torch, in float64 too;
cpu (Numba) and cuda (Triton) hold kernels, which are tested against it; `__init__.py` chooses one
of them. The scans' `reference.py` also has a fast implementation in torch. Their kernels are in
`kernels.py`, and the `__init__.py` beside it runs both passes.
"""

from asysplat.ops.conv_silu import conv_silu
from asysplat.ops.grid_attention import grid_attention
from asysplat.ops.image_loss import image_loss
from asysplat.ops.selective_scan import selective_scan
from asysplat.ops.ssd import ssd

__all__ = ["conv_silu", "grid_attention", "image_loss", "selective_scan", "ssd"]
