"""A sequence of layers, optionally with activation checkpointing."""

from collections.abc import Collection, Generator
from contextlib import contextmanager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint


class Layers(nn.ModuleList):
    """Layers in sequence.

    With `checkpointing`, the backward pass computes each layer again, and only the tokens between
    layers stay in memory (Chen et al. 2016).
    """

    checkpointing = False

    def forward(
        self, tokens: Float[Tensor, "B V h w d"], skip_layers: Collection[nn.Module] = ()
    ) -> Float[Tensor, "B V h w d"]:
        """Apply the layers in order, except `skip_layers`."""
        for layer in self:
            if layer in skip_layers:
                continue
            if self.checkpointing and torch.is_grad_enabled():
                contexts = (nullcontext(), _without_running_means(layer))
                tokens = checkpoint(
                    layer, tokens, use_reentrant=False, context_fn=lambda c=contexts: c
                )
            else:
                tokens = layer(tokens)
        return tokens


@contextmanager
def _without_running_means(layer: nn.Module) -> Generator[None]:
    """Freeze the running means of BatchNorm: the layer has counted this batch already."""
    norms = [m for m in layer.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 0.0
        if norm.num_batches_tracked is not None:
            norm.num_batches_tracked -= int(norm.training)
    try:
        yield
    finally:
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum
