"""The device that a command computes on."""

import torch

from asysplat.errors import InputError

NAMES = ("auto", "cpu", "cuda")


def find_device(name: str) -> torch.device:
    """Return the device called `name`; "auto" is the GPU where there is one.

    Raises:
        InputError: another name, or a GPU where there is none.
    """
    if name not in NAMES:
        raise InputError(f"device={name} is unknown: choose from {', '.join(NAMES)}.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device=cuda is not there: torch finds no GPU; take device=cpu.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
