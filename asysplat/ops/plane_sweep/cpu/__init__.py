"""The plane sweep for CPUs (Numba): sixteen planes of a pixel at a time."""

from asysplat.ops.plane_sweep.cpu.match import match
from asysplat.ops.plane_sweep.cpu.smooth import smooth
from asysplat.ops.plane_sweep.cpu.votes import count_votes

__all__ = ["count_votes", "match", "smooth"]
