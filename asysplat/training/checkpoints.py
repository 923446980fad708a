"""Find the checkpoint to resume or to start from, and check that it fits the model.

A checkpoint is what a run writes (.ckpt), or weights alone (.safetensors), as those that ship.
"""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.files import atomic_write

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "asysplat_plane_sweep.safetensors"
LAST, PREVIOUS = "last.ckpt", "previous.ckpt"  # of a run, to go on from
LISTED = 5  # differences between a file and a model


def find_checkpoint(asked: str | None, run: Path, runs: Path) -> Path | None:
    """Find the checkpoint that a run goes on from, and say which it is.

    Args:
        asked: None, a file, or "last" for the last one of the newest run below `runs`.
        run: the run's own folder: if it or one of its stages has checkpoints, the run was cut off
            and goes on.
        runs: folder of all runs of one name.

    Raises:
        InputError: there is no such file, or it is damaged, and so is the one before it.
    """
    if any(has_checkpoints(folder) for folder in (run, *run.glob("*/"))):
        path = newest_folder(run) / "checkpoints" / LAST
    elif asked is None:
        return None
    elif asked == "last":
        path = newest_folder(runs) / "checkpoints" / LAST
    else:
        path = Path(asked)
    return _whole(path)


def has_checkpoints(folder: Path) -> bool:
    """Return whether the folder of a run, or of one of its stages, has one to go on from."""
    return any((folder / "checkpoints" / name).exists() for name in (LAST, PREVIOUS))


def newest_folder(runs: Path) -> Path:
    """Return the folder, `runs` or below, with the newest checkpoint to go on from.

    Raises:
        InputError: there is none.
    """
    found = [path for name in (LAST, PREVIOUS) for path in runs.rglob(f"checkpoints/{name}")]
    if not found:
        raise InputError(
            f"ckpt_path=last found no checkpoints/{LAST} in {runs}: "
            "leave ckpt_path out to start a new run, or set name= to that of the run."
        )
    return max(found, key=lambda path: path.stat().st_mtime).parents[1]


def _whole(path: Path) -> Path:
    """Return `path`, or the checkpoint before it if that of the name LAST is absent or damaged."""
    trouble = _trouble(path)
    before = path.with_name(PREVIOUS)
    if trouble and path.name == LAST and _trouble(before) is None:
        print(f"{path} {trouble}: going on from the one before it", flush=True)
        path, trouble = before, None
    if trouble:
        raise InputError(
            f"ckpt_path={path} {trouble}: name a .ckpt file that a run has written, or last."
        )
    print(f"going on from {path}", flush=True)
    return path


def _trouble(path: Path) -> str | None:
    """Say what is wrong with a checkpoint; None if every byte is as it was written."""
    if not path.is_file():
        return "does not exist"
    try:
        with zipfile.ZipFile(path) as parts:
            bad = parts.testzip()  # torch itself compares no checksums
    except Exception:  # zipfile's are of many kinds
        return "cannot be read as a checkpoint"
    return None if bad is None else f"is damaged, at {bad}"


def read_notes(path: Path) -> dict[str, Any]:
    """Read what a run's checkpoint says beside its weights, which stay on the disk.

    `hyper_parameters` is the configuration; see also `Checkpoints`.
    """
    return torch.load(path, map_location="meta", mmap=True, weights_only=True)


def config_diff(notes: Mapping[str, Any], config: Mapping[str, Any], revision: str) -> list[str]:
    """List how a run that goes on is not the one that wrote a checkpoint: its bits will differ.

    Args:
        notes: the checkpoint's, see `read_notes`.
        config: the configuration, of plain values.
        revision: of the code.
    """
    before, now = (_flat(options) for options in (notes.get("hyper_parameters", {}), config))
    keys = [key for key in before.keys() & now.keys() if before[key] != now[key]]
    options = [f"{k}={now[k]}, it was {before[k]}" for k in sorted(keys) if not _is_place(k)]
    if notes.get("revision", revision) != revision:
        options.append(f"the code is {revision}, it was {notes['revision']}")
    return options


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested options by their dotted keys."""
    flat = {}
    for key, value in options.items():
        nested = isinstance(value, Mapping)
        flat |= _flat(value, f"{prefix}{key}.") if nested else {prefix + key: value}
    return flat


def _is_place(key: str) -> bool:
    return key == "ckpt_path" or key.startswith(("paths.", "callbacks."))


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
    with atomic_write(path) as partial:
        partial.write_bytes(save(halves))


def write_whole(values: Any, path: Path) -> None:
    """Write values with torch.save: the file is there whole or not at all.

    Raises:
        InputError: there is no room, or one may not write there.
    """
    with atomic_write(path) as partial, open(partial, "wb") as file:
        try:
            torch.save(values, file)
        except RuntimeError as error:
            # torch hides why it could not write.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


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
