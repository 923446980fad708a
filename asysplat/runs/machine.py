"""The device that a command computes on, and the revision of the code."""

import hashlib
import subprocess
from functools import cache

import psutil
import torch

from asysplat.errors import InputError
from asysplat.root import ROOT, __version__

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


def free_gb(device: torch.device) -> float:
    """Return the memory of a device that is free, in GB."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0] / 1e9
    return psutil.virtual_memory().available / 1e9


def find_accelerator(name: str) -> str:
    """Return Lightning's accelerator called `name`; "auto" is the CPU where the GPU is Apple's."""
    apple = torch.backends.mps.is_available() and not torch.cuda.is_available()
    if name == "mps" or (name == "gpu" and apple):
        raise InputError(f"trainer.accelerator={name} {NO_APPLE_GPU} trainer.accelerator=cpu.")
    return "cpu" if name == "auto" and apple else name


CODE = ("asysplat", "conf", "train.py")


@cache
def revision() -> str:
    """Return the git commit of the code that this process runs, or the version outside of git.

    If tracked files of CODE differ from the commit, "+" and a hash of the differences follow.
    """
    commit = _git("rev-parse", "--short=12", "HEAD")
    changes = _git("diff", "HEAD", "--", *CODE)
    # A package installed below somebody else's repository is not part of it.
    if _git("rev-parse", "--show-cdup") != b"\n" or commit is None or changes is None:
        return __version__ if __version__ == "unknown" else f"version {__version__}"
    mark = f"+{hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
    return commit.decode().strip() + mark


def _git(*arguments: str) -> bytes | None:
    """Return what git prints; None if it fails or is not installed."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
