"""Average over the micro-batches of an optimizer step and over all processes."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm


class AccumulatedMetrics:
    """Averages the terms of the loss and the running means of batch norms over an optimizer step.

    Both equal those of one process with the whole batch. Every micro-batch starts from the same
    running means.
    """

    def __init__(self, net: nn.Module):
        norms = [module for module in net.modules() if isinstance(module, _BatchNorm)]
        self.buffers = [b for norm in norms for b in (norm.running_mean, norm.running_var)]
        self.terms: list[dict[str, Tensor]] = []
        self.updated: list[list[Tensor]] = []

    def start(self) -> None:
        """Begin an optimizer step."""
        self.before = [buffer.clone() for buffer in self.buffers]
        self.terms, self.updated = [], []

    def add(self, terms: dict[str, Tensor]) -> None:
        """Add a micro-batch after its forward pass."""
        self.terms.append({name: term.detach() for name, term in terms.items()})
        self.updated.append([buffer.clone() for buffer in self.buffers])
        self._set(self.before)

    def finish(self, reduce: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Update the running means; return the mean of every term; `reduce`: over processes."""
        updated = zip(*self.updated, strict=True)
        self._set([reduce(torch.stack(values).mean(0)) for values in updated])
        names = list(self.terms[0])
        means = torch.stack([torch.stack([terms[n] for terms in self.terms]).mean() for n in names])
        return dict(zip(names, reduce(means), strict=True))

    def _set(self, values: list[Tensor]) -> None:
        for buffer, value in zip(self.buffers, values, strict=True):
            # By .data, as a batch norm's pending backward pass has saved the buffer.
            buffer.data.copy_(value)
