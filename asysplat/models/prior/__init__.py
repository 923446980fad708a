"""Priors: surface depths known before the network runs; ours, not the paper's.

A prior maps views and the size of the head's grid to a `Prior`. The tokenizers read its distance
and confidence at each pixel; the head corrects its distance and starts from its opacity. Without
one (`model/prior=none`) the network is the paper's.
"""

from asysplat.models.prior.plane_sweep import PlaneSweepPrior
from asysplat.models.prior.prior import PRIOR_CHANNELS, DepthPrior, PointsPrior, Prior

__all__ = ["PRIOR_CHANNELS", "DepthPrior", "PlaneSweepPrior", "PointsPrior", "Prior"]
