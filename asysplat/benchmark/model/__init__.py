"""Whole networks: seconds of a forward pass and of a training step, what they go into, and the
least that their matrix products take."""

from asysplat.benchmark.model.measure import measure
from asysplat.benchmark.model.plot import plot
from asysplat.benchmark.model.tables import tables

__all__ = ["measure", "plot", "tables"]
