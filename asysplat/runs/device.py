"""The device that a command computes on."""

import torch

from asysplat.errors import InputError

NAMES = ("auto", "cpu", "cuda")
NO_APPLE_GPU = "is not supported: Apple's GPU has no float64, which cameras need; take"


def find_device(name: str) -> torch.device:
    """Return a device by name; "auto" is the GPU where there is one, unless it is Apple's."""
    if name == "mps":
        raise InputError(f"device=mps {NO_APPLE_GPU} device=cpu.")
    if name not in NAMES:
        raise InputError(f"device={name} is unknown: choose from {', '.join(NAMES)}.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device=cuda is not there: torch finds no GPU; take device=cpu.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def find_accelerator(name: str) -> str:
    """Return Lightning's accelerator called `name`; "auto" is the CPU where the GPU is Apple's."""
    apple = torch.backends.mps.is_available() and not torch.cuda.is_available()
    if name == "mps" or (name == "gpu" and apple):
        raise InputError(f"trainer.accelerator={name} {NO_APPLE_GPU} trainer.accelerator=cpu.")
    return "cpu" if name == "auto" and apple else name
