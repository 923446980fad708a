"""Signals of scripts: Ctrl-C, the end of a terminal session, and those of a scheduler."""

import math
import os
import signal
import stat
import time
from types import FrameType

MIN_SECONDS = 1.0  # between two interrupts


def handle_signals() -> None:
    """Set the signal handlers of a script; after its imports, as pycolmap sets some of its own.

    SIGHUP, of a terminal that was closed, counts as SIGTERM unless it is ignored (`nohup`).
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _hang_up)


def _hang_up(number: int, frame: FrameType | None) -> None:
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # to write to a closed terminal is an error
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    os.kill(os.getpid(), signal.SIGTERM)


def end_at_interrupt() -> None:
    """End the process at Ctrl-C without a traceback: while modules load, nothing is to clean up."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def interrupt_once() -> None:
    """Raise KeyboardInterrupt at a Ctrl-C, and ignore others for MIN_SECONDS, while a run ends."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        return
    last = -math.inf

    def interrupt(*_: object) -> None:
        nonlocal last
        previous, last = last, time.monotonic()
        if last - previous > MIN_SECONDS:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
