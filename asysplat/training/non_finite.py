"""Repeat a step to find its first non-finite tensor."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor

Batch = dict[str, Any]


def first_non_finite(module: LightningModule, batch: Batch) -> str | None:
    """Compute a batch's loss and gradients; name the first tensor that is NaN or infinite.

    The order is: inputs, outputs of modules (inner before outer ones), terms of the loss, gradients
    at those outputs from the last to the first, gradients of parameters. `module` has
    `compute_terms(batch, net)`, whose "loss" is minimized; it is left as it was.
    """
    names: list[str] = []

    def check(name: str, value: Any) -> None:
        bad = (part for part, tensor in tensors(value) if not tensor.isfinite().all())
        names.extend(f"{name}{part}" for part in bad)

    def check_output(name: str, _: Any, __: Any, output: Any) -> None:
        check(f"the output of {name}", output)
        for part, tensor in tensors(output):
            if tensor.requires_grad:
                tensor.register_hook(partial(check, f"the gradient at the output of {name}{part}"))

    for name in ("inputs", "targets"):
        check(f"the batch's {name}", batch[name])
    hooks = [
        part.register_forward_hook(partial(check_output, name))
        for name, part in module.named_modules()
        if name
    ]
    buffers = [buffer.clone() for buffer in module.buffers()]
    try:
        with torch.enable_grad():
            terms = module.compute_terms(batch, module.net)
            for name, term in terms.items():
                check(f"the term {name} of the loss", term)
            trained = {name: p for name, p in module.named_parameters() if p.requires_grad}
            grads = torch.autograd.grad(terms["loss"], list(trained.values()), allow_unused=True)
    finally:
        for hook in hooks:
            hook.remove()
        for buffer, before in zip(module.buffers(), buffers, strict=True):
            buffer.copy_(before)
    for name, grad in reversed(list(zip(trained, grads, strict=True))):
        check(f"the gradient of {name}", grad)
    return names[0] if names else None


def tensors(value: Any, part: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield the path, as ".cameras.intrinsics" or "[0]", and value of each nested float tensor."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield part, value
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors(getattr(value, field.name), f"{part}.{field.name}")
    elif isinstance(value, Mapping):
        for key, each in value.items():
            yield from tensors(each, f"{part}.{key}")
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value):
            yield from tensors(each, f"{part}[{index}]")
