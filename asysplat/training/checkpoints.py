"""Find the checkpoint to resume or to start from, and check that it fits the model.

A checkpoint is what a run writes (.ckpt), or weights alone (.safetensors), as those that ship.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.files import replaced

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "asysplat_sweep.safetensors"
LISTED = 5  # differences between a file and a model


def find_checkpoint(asked: str | None, runs: Path) -> Path | None:
    """Find the checkpoint that `ckpt_path` names.

    Args:
        asked: None, a file, or "last" for the newest `last.ckpt` below `runs`.
        runs: folder of all runs of one name.

    Raises:
        InputError: there is no such file.
    """
    if asked is None:
        return None
    if asked != "last":
        if not Path(asked).is_file():
            raise InputError(f"ckpt_path={asked} does not exist: name a .ckpt file, or last.")
        return Path(asked)
    found = sorted(runs.rglob("checkpoints/last.ckpt"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise InputError(
            f"ckpt_path=last found no checkpoints/last.ckpt in {runs}: "
            "leave ckpt_path out to start a new run, or set name= to that of the run."
        )
    print(f"going on from {found[-1]}")
    return found[-1]


def check_checkpoint(path: Path | None, module: nn.Module) -> None:
    """Check the names and shapes of the weights before training.

    Raises:
        InputError: the file cannot be read, or holds the weights of another model.
    """
    if path is None:
        return
    _check_state(_read_shapes(path), path, module)


def _check_state(state: dict[str, tuple[int, ...]], path: Path, module: nn.Module) -> None:
    """Check names and shapes, those of a file at `path`, against the module's.

    Raises:
        InputError: they differ.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    names = sorted(expected.keys() | state.keys())
    differing = [name for name in names if state.get(name) != expected.get(name)]
    if not differing:
        return
    listed = [f"{n} is {state.get(n)} there and {expected.get(n)} here" for n in differing[:LISTED]]
    raise InputError(
        f"{path} does not fit this model, {len(differing)} of {len(names)} weights differ: "
        f"{', '.join(listed)}{', ...' if len(differing) > LISTED else ''}; give the options that "
        "it was trained with (a run's config.yaml, or the card beside a .safetensors file)."
    )


def read_callbacks(path: Path) -> dict[str, Any]:
    """Read what the callbacks of a run left in its checkpoint, by their names.

    Raises:
        InputError: the file cannot be read as a run's checkpoint.
    """
    try:
        return torch.load(path, map_location="meta", weights_only=True)["callbacks"]
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a checkpoint to resume from: name a .ckpt file that a run "
            "has written."
        ) from error


def load_weights(path: str | None, module: nn.Module) -> None:
    """Load weights, if a path is given, but neither optimizer nor schedule.

    Args:
        path: None, a .ckpt or .safetensors file, or "shipped" for the model in checkpoints/.
        module: takes them.

    Raises:
        InputError: there is no such file, or it does not fit.
    """
    if path is None:
        return
    file = weights_file(path)
    if not file.is_file():
        raise InputError(
            f"init_path={path} does not exist: name a .ckpt or .safetensors file, or shipped."
        )
    check_checkpoint(file, module)
    module.load_state_dict(_read_weights(file))


def weights_file(path: str) -> Path:
    """Return the file that `init_path` names."""
    return SHIPPED if path == "shipped" else Path(path)


def save_weights(weights: Mapping[str, Tensor], path: Path) -> None:
    """Write a state dict in half precision: what a published model is read from."""
    halves = {
        name: (tensor.half() if tensor.is_floating_point() else tensor).contiguous()
        for name, tensor in weights.items()
    }
    with replaced(path) as partial:
        partial.write_bytes(save(halves))


def _read_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Read the shapes of the weights in a file, by name, and as little else as possible."""
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, "pt") as file:
                return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        state = torch.load(path, map_location="meta", weights_only=True)["state_dict"]
        return {name: tuple(tensor.shape) for name, tensor in state.items()}
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a checkpoint: name a .ckpt file that a run has written, or "
            "a .safetensors file."
        ) from error


def _read_weights(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        return load_file(path)
    return torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
