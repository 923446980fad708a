"""The operators in which training and reconstruction spend their time.

Each is a folder: `reference.py` reads like the formula and takes float64; cpu (Numba) and cuda
(Triton) hold the kernels, tested against it; `__init__.py` chooses. The scans also have
`chunked.py`, a fast form in torch; of their kernels `scan.py` runs both passes, `forward.py` and
`backward.py` hold those of each pass, and `chunk.py` what these share.
"""

from asysplat.ops.grid_attention import grid_attention
from asysplat.ops.image_loss import image_loss
from asysplat.ops.selective_scan import selective_scan
from asysplat.ops.ssd import ssd

__all__ = ["grid_attention", "image_loss", "selective_scan", "ssd"]
