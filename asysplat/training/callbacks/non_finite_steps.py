"""Drop, count and report steps with non-finite gradients."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.optim import Optimizer

from asysplat.errors import InputError
from asysplat.training.parallel_scenes import Batch, split
from asysplat.training.random_states import RandomStates, random_states, set_random_states


class NonFiniteSteps(Callback):
    """Drops a step with a NaN or infinite gradient, and restores the buffers that it changed.

    The step is then computed again, scene by scene, to report the scene and the first tensor that
    is not finite.

    Args:
        budget: the run ends after this many non-finite steps in a row.
    """

    def __init__(self, budget: int = 10):
        self.budget = budget
        self.count, self.in_a_row = 0, 0
        self.batches: list[tuple[Batch, RandomStates]] = []  # the step's micro-batches
        self.buffers: list[Tensor] = []  # copies from before the step

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.count, self.in_a_row = state_dict["count"], state_dict["in_a_row"]

    def on_train_batch_start(
        self, trainer: Trainer, module: LightningModule, batch: Batch, index: int
    ) -> None:
        if index % trainer.accumulate_grad_batches == 0:
            self.batches = []
            self.buffers = [buffer.clone() for buffer in module.buffers()]
        self.batches.append((batch, random_states()))

    def on_before_optimizer_step(
        self, trainer: Trainer, module: LightningModule, optimizer: Optimizer
    ) -> None:
        named = [(name, p.grad) for name, p in module.named_parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm([grad for _, grad in named])
        module.log("train/grad_norm", norm)
        if trainer.strategy.reduce_boolean_decision(bool(norm.isfinite())):
            self.in_a_row = 0
            return
        self.count += 1
        self.in_a_row += 1
        bad = [f"the gradient of {name}" for name, grad in named if not grad.isfinite().all()]
        optimizer.zero_grad(set_to_none=True)
        for buffer, before in zip(module.buffers(), self.buffers, strict=True):
            buffer.copy_(before)
        first, scenes = self._recompute(trainer, module) or (
            bad[0] if bad else "the sum of all gradients",
            [scene for batch, _ in self.batches for scene in batch["scene"]],
        )
        print(
            f"step {trainer.global_step}: {first} is not finite on {', '.join(scenes)}; "
            f"the step is dropped ({self.count} in all)",
            flush=True,
        )
        if self.in_a_row >= self.budget:
            raise InputError(
                f"{self.in_a_row} steps in a row had a non-finite gradient (last: {first}): "
                "lower learning_rate or set trainer.precision=32-true."
            )

    def _recompute(self, trainer: Trainer, module: LightningModule) -> tuple[str, list[str]] | None:
        """Return the tensor and the scene; None if all is finite now."""
        current_states = random_states()
        try:
            for batch, states in self.batches:
                set_random_states(states)
                for scene in split(batch):
                    context = trainer.precision_plugin.forward_context
                    first = first_non_finite(module, scene, context)
                    if first is not None:
                        return first, scene["scene"]
        finally:
            set_random_states(current_states)
        return None

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        module.log("train/non_finite_steps", float(self.count))


def first_non_finite(
    module: LightningModule,
    batch: Batch,
    context: Callable[[], AbstractContextManager] = nullcontext,
) -> str | None:
    """Compute a batch's loss and gradients; name the first tensor that is NaN or infinite.

    The order is: inputs, outputs of modules (inner before outer ones), terms of the loss, gradients
    at those outputs from the last to the first, gradients of parameters. `module` has
    `scene_terms(batch, net)`, whose "loss" is minimized; it is left as it was. `context` is that of
    the forward pass, such as autocast.
    """
    names: list[str] = []

    def check(name: str, value: object) -> None:
        bad = (part for part, tensor in tensors(value) if not tensor.isfinite().all())
        names.extend(f"{name}{part}" for part in bad)

    def check_output(name: str, _: nn.Module, __: object, output: object) -> None:
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
            with context():
                terms = module.scene_terms(batch, module.net)
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


def tensors(value: object, part: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield the path, as ".cameras.intrinsics" or "[0]", and value of each nested float tensor."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield part, value
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors(getattr(value, field.name), f"{part}.{field.name}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from tensors(item, f"{part}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from tensors(item, f"{part}[{index}]")
