"""The plane sweep for GPUs (Triton): a program takes some columns and planes of a view.

The consistency check runs in torch.
"""

from asysplat.ops.plane_sweep.cuda.cost_volume import cost_volume
from asysplat.ops.plane_sweep.cuda.sgm import sgm
from asysplat.ops.plane_sweep.reference import consistency

__all__ = ["consistency", "cost_volume", "sgm"]
