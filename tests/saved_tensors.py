"""What autograd keeps of a forward pass."""

import torch
from torch import nn


def saved_bytes(module: nn.Module, forward):
    """Return the result, and the bytes saved for the backward pass beside the module's own."""
    own = {t.untyped_storage().data_ptr() for t in (*module.parameters(), *module.buffers())}
    kept = {}

    def keep(tensor):
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = forward()
    return result, sum(s.nbytes() for address, s in kept.items() if address not in own)
