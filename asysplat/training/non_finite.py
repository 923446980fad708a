"""Repeat a step to find its first non-finite tensor; save the step to a file.

python -m asysplat.training.non_finite logs/asysplat/2026-01-31_12-00-00/non_finite/step-000012-0.pt
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Fabric, LightningModule
from omegaconf import OmegaConf
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Cameras, Views
from asysplat.training.checkpoints import atomic_save
from asysplat.training.old_names import upgrade_config
from asysplat.training.random_states import RandomStates, set_random_states

Batch = dict[str, Any]


def first_non_finite(module: LightningModule, batch: Batch) -> str | None:
    """Compute a batch's loss and gradients; name the first tensor that is NaN or infinite.

    The order is: inputs, outputs of modules (inner before outer ones), terms of the loss, gradients
    at those outputs from the last to the first, gradients of parameters.

    Args:
        module: has `compute_terms(batch, net)`, whose "loss" is minimized. It is left as it was.
        batch: inputs and targets, both Views.
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


def save_step(path: Path, module: LightningModule, batch: Batch, states: RandomStates) -> None:
    """Write everything that a step depends on, to be read with weights_only=True.

    Args:
        path: the file; its folder is created.
        module: its `hparams` are the configuration of the run.
        batch: inputs and targets, both Views.
        states: of the random generators, before the step.

    Raises:
        InputError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    step = {
        "configuration": dict(module.hparams),
        "state_dict": module.state_dict(),
        "random_states": states,
        "scene": batch["scene"],
        **{name: asdict(batch[name]) for name in ("inputs", "targets")},
    }
    atomic_save(step, path)


def replay(path: Path) -> str | None:
    """Repeat a saved step; name the first non-finite tensor, see `first_non_finite`.

    Raises:
        InputError: the file was not written by `save_step`.
    """
    try:
        step = torch.load(path, map_location="cpu", weights_only=True)
        config = OmegaConf.create(upgrade_config(step["configuration"]))
    except Exception as error:
        raise InputError(f"{path} cannot be read as a step: name a file of non_finite/.") from error
    module = instantiate(config.training, net=instantiate(config.model))
    module.load_state_dict(step["state_dict"])
    device = "cuda" if torch.cuda.is_available() else "cpu"
    batch = {name: _views(step[name]).to(device) for name in ("inputs", "targets")}
    module.train().to(device)
    set_random_states(step["random_states"])
    with Fabric(accelerator=device, devices=1, precision=config.trainer.precision).autocast():
        return first_non_finite(module, batch | {"scene": step["scene"]})


def _views(parts: dict[str, Any]) -> Views:
    return Views(**(parts | {"cameras": Cameras(**parts["cameras"])}))


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python -m asysplat.training.non_finite FILE")
    try:
        print(replay(Path(sys.argv[1])) or "all tensors are finite")
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
