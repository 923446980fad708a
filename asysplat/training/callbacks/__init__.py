"""What watches a run: metrics, pictures, learning curve, costs, non-finite steps."""

from asysplat.training.callbacks.costs import Costs
from asysplat.training.callbacks.curve import Curve
from asysplat.training.callbacks.guard import SkipNonFiniteSteps
from asysplat.training.callbacks.metrics import Metrics
from asysplat.training.callbacks.pictures import Pictures

__all__ = ["Costs", "Curve", "Metrics", "Pictures", "SkipNonFiniteSteps"]
