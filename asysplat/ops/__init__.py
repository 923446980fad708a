"""The operators that a reconstruction spends its time in.

Each is a folder: `reference.py` reads like the formula and takes float64, the other files are
faster forms that are tested against it. Those of the scans: `chunked.py` in torch, and the kernels
in cpu/ and cuda/, where `scan.py` runs both passes, `forward.py` and `backward.py` hold the kernels
of each, and `chunk.py` what these share.
"""

from asysplat.ops.grid_attention import grid_attention
from asysplat.ops.image_loss import image_loss
from asysplat.ops.plane_sweep import plane_sweep
from asysplat.ops.selective_scan import selective_scan
from asysplat.ops.ssd import ssd

__all__ = ["grid_attention", "image_loss", "plane_sweep", "selective_scan", "ssd"]
