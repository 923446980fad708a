"""Run train.py in processes that start at once, to be killed at any time."""

import multiprocessing
import os
import runpy
import signal
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
# Forked from a process that has imported the slow modules and computed nothing.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["asysplat.training.callbacks", "asysplat.data", "hydra.main"])


def start(output: Path, *overrides: str) -> BaseProcess:
    """Start train.py in a process; append what it prints to a file."""
    process = CONTEXT.Process(target=_train, args=(output, overrides))
    process.start()
    return process


def _train(output: Path, overrides: tuple[str, ...]) -> None:
    os.setsid()  # for signals to all of its processes
    signal.signal(signal.SIGINT, signal.default_int_handler)  # however the tests were started
    os.chdir(REPO)
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(descriptor, stream.fileno())
        stream.reconfigure(line_buffering=True)
    sys.argv = [str(REPO / "train.py"), *overrides]
    runpy.run_path(str(REPO / "train.py"), run_name="__main__")
