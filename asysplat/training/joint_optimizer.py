"""Several optimizers as one, for parameters that each suit one of them."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch.optim import Optimizer


class JointOptimizer(Optimizer):
    """Steps optimizers of disjoint parameters as one, whose state and groups are those of all.

    A schedule multiplies the rates of all groups; each group keeps its own rate.
    """

    def __init__(self, *optimizers: Optimizer):
        self.optimizers = optimizers
        super().__init__([group for part in optimizers for group in part.param_groups], {})
        self._share()

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step every optimizer, after the closure has computed the gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.optimizers:
            part.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the state and the groups of all optimizers."""
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Give every optimizer its groups and the common state, as the same objects."""
        self.state = defaultdict(dict, self.state)
        start = 0
        for part in self.optimizers:
            count = len(part.param_groups)
            part.param_groups = self.param_groups[start : start + count]
            part.state = self.state
            start += count
