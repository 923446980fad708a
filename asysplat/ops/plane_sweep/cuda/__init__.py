"""The plane sweep for GPUs (Triton)."""

from asysplat.ops.plane_sweep.cuda.consistency import consistency
from asysplat.ops.plane_sweep.cuda.cost_volume import cost_volume
from asysplat.ops.plane_sweep.cuda.sgm import sgm
from asysplat.ops.plane_sweep.cuda.spread import spread

__all__ = ["consistency", "cost_volume", "sgm", "spread"]
