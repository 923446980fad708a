"""The plane sweep for GPUs (Triton): a program takes some columns and planes of a view."""

from asysplat.ops.plane_sweep.cuda.match import match
from asysplat.ops.plane_sweep.cuda.smooth import smooth

__all__ = ["match", "smooth"]
