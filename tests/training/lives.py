"""Training in processes that start in a moment, to be killed at any."""

import multiprocessing
import os
import runpy
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
# Forked from a process that has imported what takes long, and computed nothing.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["asysplat.training.callbacks", "asysplat.data", "hydra.main"])


def begin(said: Path, *overrides: str, environment: dict[str, str] | None = None) -> BaseProcess:
    """Start train.py in a process of its own; what it says goes to the end of a file."""
    process = CONTEXT.Process(target=_train, args=(said, overrides, environment or {}))
    process.start()
    return process


def _train(said: Path, overrides: tuple[str, ...], environment: dict[str, str]) -> None:
    os.setsid()  # for signals to all of its processes
    os.chdir(REPO)
    os.environ.update(environment)
    descriptor = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(descriptor, stream.fileno())
        stream.reconfigure(line_buffering=True)
    sys.argv = [str(REPO / "train.py"), *overrides]
    runpy.run_path(str(REPO / "train.py"), run_name="__main__")
