"""The plane sweep for GPUs (Triton): a program takes some columns and planes of a view.

Votes are counted in torch.
"""

from asysplat.ops.plane_sweep.cuda.match import match
from asysplat.ops.plane_sweep.cuda.smooth import smooth
from asysplat.ops.plane_sweep.reference import count_votes

__all__ = ["count_votes", "match", "smooth"]
