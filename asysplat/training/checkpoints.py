"""Find the checkpoint to resume or to start from, and check that it fits the model."""

from pathlib import Path

import torch
from torch import nn

from asysplat.errors import InputError


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
    try:
        state = torch.load(path, map_location="meta", weights_only=True)["state_dict"]
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a checkpoint: name a .ckpt file that a run has written."
        ) from error
    expected = module.state_dict()
    for name in sorted(expected.keys() | state.keys()):
        there, here = state.get(name), expected.get(name)
        if there is None or here is None or there.shape != here.shape:
            sizes = [None if t is None else tuple(t.shape) for t in (there, here)]
            raise InputError(
                f"{path} does not fit this model: {name} is {sizes[0]} there and {sizes[1]} here; "
                "give the options that the run was started with (see its config.yaml)."
            )


def load_weights(path: str | None, module: nn.Module) -> None:
    """Load the weights of the checkpoint `path`, if given, but neither optimizer nor schedule.

    Raises:
        InputError: there is no such file, or it does not fit.
    """
    if path is None:
        return
    if not Path(path).is_file():
        raise InputError(f"init_path={path} does not exist: name a .ckpt file.")
    check_checkpoint(Path(path), module)
    module.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["state_dict"])
