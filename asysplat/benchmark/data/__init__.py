"""Photographs on disk: how soon a scene opens, and whether loading keeps ahead of the network."""

from asysplat.benchmark.data.measure import measure
from asysplat.benchmark.data.plot import plot
from asysplat.benchmark.data.tables import tables

__all__ = ["measure", "plot", "tables"]
