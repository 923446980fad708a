"""Find the checkpoint to resume or to start from, and check that it fits the model.

A checkpoint is what a run writes (.ckpt), or weights alone (.safetensors).
"""

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load
from torch import nn

from asysplat.errors import InputError
from asysplat.files import atomic_write
from asysplat.runs.run_config import flat_options

LAST, PREVIOUS = "last.ckpt", "previous.ckpt"  # checkpoints of a run to resume from
# Options that change no weight.
WITHOUT_EFFECT = ("ckpt_path", "paths.", "callbacks.", "trainer.num_sanity_val_steps")


def find_checkpoint(
    ckpt_path: str | None, run: Path, runs: Path, *, say: Callable[[str], object] = print
) -> Path | None:
    """Find the checkpoint that a run resumes from, and say its path.

    Args:
        ckpt_path: None, a file, or "last" for the last one of the newest run below `runs`.
        run: the run's own folder; if it or one of its stages has checkpoints, it was interrupted.
    """
    if any(has_checkpoints(folder) for folder in (run, *run.glob("*/"))):
        path = newest_folder(run) / "checkpoints" / LAST
    elif ckpt_path is None:
        return None
    elif ckpt_path == "last":
        path = newest_folder(runs) / "checkpoints" / LAST
    else:
        path = Path(ckpt_path)
    damage, before = _damage(path), path.with_name(PREVIOUS)
    if damage and path.name == LAST and _damage(before) is None:
        say(f"{path} {damage}: resuming from the one before it")
        path, damage = before, None
    if damage:
        raise InputError(
            f"ckpt_path={path} {damage}: name a .ckpt file that a run has written, or last."
        )
    say(f"resuming from {path}")
    return path


def has_checkpoints(folder: Path) -> bool:
    """Return whether the folder of a run, or of one of its stages, has one to resume from."""
    return any((folder / "checkpoints" / name).exists() for name in (LAST, PREVIOUS))


def newest_folder(runs: Path) -> Path:
    """Return the folder, `runs` or below, with the newest checkpoint to resume from."""
    paths = [path for name in (LAST, PREVIOUS) for path in runs.rglob(f"checkpoints/{name}")]
    if not paths:
        raise InputError(
            f"ckpt_path=last found no checkpoints/{LAST} in {runs}: "
            "leave ckpt_path out to start a new run, or set name= to that of the run."
        )
    return max(paths, key=lambda path: path.stat().st_mtime).parents[1]


def _damage(path: Path) -> str | None:
    """Describe the damage of a checkpoint; None if its checksums are right."""
    if not path.is_file():
        return "does not exist"
    try:
        with zipfile.ZipFile(path) as parts:
            damaged = parts.testzip()  # torch itself compares no checksums
    except Exception:  # zipfile raises many kinds
        return "cannot be read as a checkpoint"
    return None if damaged is None else f"is damaged, at {damaged}"


def read_metadata(path: Path) -> dict[str, Any]:
    """Read a run's checkpoint, such as its `hyper_parameters`; its weights stay on the disk."""
    try:
        return torch.load(path, map_location="meta", mmap=True, weights_only=True)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a checkpoint to resume from: name a .ckpt file that a run "
            "has written."
        ) from error


def config_diff(metadata: Mapping[str, Any], config: Mapping[str, Any], revision: str) -> list[str]:
    """List what differs from a checkpoint with this metadata: the bits of the runs will differ."""
    before, current = flat_options(metadata.get("hyper_parameters", {})), flat_options(config)
    keys = [key for key in before.keys() & current.keys() if before[key] != current[key]]
    keys = [key for key in sorted(keys) if not key.startswith(WITHOUT_EFFECT)]
    differences = [f"{key}={current[key]}, it was {before[key]}" for key in keys]
    if metadata.get("revision", revision) != revision:
        differences.append(f"the code is {revision}, it was {metadata['revision']}")
    return differences


def check_checkpoint(path: Path, module: nn.Module) -> None:
    """Check the names and shapes of the weights before training."""
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, "pt") as file:
                names = file.keys()
                shapes = {name: tuple(file.get_slice(name).get_shape()) for name in names}
        else:
            state = torch.load(path, map_location="meta", weights_only=True)["state_dict"]
            shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a checkpoint: name a .ckpt file that a run has written, or "
            "a .safetensors file."
        ) from error
    expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    names = sorted(expected.keys() | shapes.keys())
    lines = [
        f"{name} is {shapes.get(name)} there and {expected.get(name)} here"
        for name in names
        if shapes.get(name) != expected.get(name)
    ]
    if not lines:
        return
    raise InputError(
        f"{path} does not fit this model, {len(lines)} of {len(names)} weights differ: "
        f"{', '.join(lines[:5])}{', ...' if len(lines) > 5 else ''}; give the options that "
        "it was trained with (a run's config.yaml)."
    )


def load_weights(path: str | None, module: nn.Module, option: str = "init_path") -> None:
    """Load the weights of a .ckpt or .safetensors file; none if `path` is None."""
    if path is None:
        return
    file = existing_weights(path, option)
    if damage := None if file.suffix == ".safetensors" else _damage(file):
        raise InputError(f"{option}={path} {damage}: copy it again, or name another file.")
    check_checkpoint(file, module)
    if file.suffix == ".safetensors":
        # Not load_file, which leaves five objects for each tensor behind (safetensors 0.8.0).
        weights = load(file.read_bytes())
    else:
        weights = torch.load(file, map_location="cpu", weights_only=True)["state_dict"]
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise InputError(f"{option}={path}: {name} has NaN or infinity: name another file.")
    module.load_state_dict(weights)


def existing_weights(path: str, option: str = "init_path") -> Path:
    """Return the file that an option names; raise InputError if there is none."""
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{option}={path} does not exist: name a .ckpt or .safetensors file.")
    return file


def atomic_save(values: object, path: Path) -> None:
    """Write values atomically with torch.save."""
    with atomic_write(path) as partial, open(partial, "wb") as file:
        try:
            torch.save(values, file)
        except RuntimeError as error:  # torch hides the reason
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise
