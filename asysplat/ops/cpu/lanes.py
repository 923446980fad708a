"""The names that the scans import, all defined in `vectors`."""

from asysplat.ops.cpu.vectors import LANES, ONE, ZERO, decay2

__all__ = ["LANES", "ONE", "ZERO", "decay2"]
