"""Every path of the operators: time beside the sequential loop and bare matmuls; error; memory."""

from asysplat.benchmark.ops.measure import measure
from asysplat.benchmark.ops.plot import plot
from asysplat.benchmark.ops.tables import tables

__all__ = ["measure", "plot", "tables"]
