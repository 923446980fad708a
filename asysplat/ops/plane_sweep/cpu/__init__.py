"""The plane sweep for CPUs (Numba): sixteen planes of a pixel at a time."""

from asysplat.ops.plane_sweep.cpu.consistency import consistency
from asysplat.ops.plane_sweep.cpu.cost_volume import cost_volume
from asysplat.ops.plane_sweep.cpu.sgm import sgm
from asysplat.ops.plane_sweep.cpu.spread import spread

__all__ = ["consistency", "cost_volume", "sgm", "spread"]
