"""Every backend of the renderer, and every skip switched off: seconds, memory, error."""

from asysplat.benchmark.render.measure import measure
from asysplat.benchmark.render.plot import plot
from asysplat.benchmark.render.tables import tables

__all__ = ["measure", "plot", "tables"]
