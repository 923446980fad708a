"""Surfaces from posed images without training: a plane sweep, or known depth maps.

The start of a refinement, and by themselves a model that a trained one has to surpass.
"""

from asysplat.models.prior.plane_sweep import PlaneSweep
from asysplat.models.prior.prior import Prior

__all__ = ["PlaneSweep", "Prior"]
