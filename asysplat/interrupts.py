"""Signals of scripts: Ctrl-C, the end of a terminal session, and those of a scheduler."""

import os
import signal
import stat
import sys
import threading
from types import FrameType

DELAY = 0.01  # seconds until the callback has returned
_interrupted = False  # by _interrupt


def handle_signals() -> None:
    """Set the signal handlers of a script; call it after its imports.

    SIGTERM ends the process without the stack trace that pycolmap would print. SIGHUP, of a
    terminal that was closed, counts as SIGTERM unless it is ignored (`nohup`). Interrupts are kept.
    """
    keep_interrupts()
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
    """Raise KeyboardInterrupt at the first Ctrl-C only, as training then saves and ends."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _interrupted
    if not _interrupted:
        _interrupted = True
        raise KeyboardInterrupt


def keep_interrupts() -> None:
    """Repeat a KeyboardInterrupt that Python can only print.

    In a finalizer, or a callback of C code (such as Numba's when it loads a kernel), Python prints
    exceptions and continues: Ctrl-C at such a moment would be lost.
    """
    previous, main = sys.unraisablehook, threading.main_thread().ident
    timer: threading.Timer | None = None

    def repeat(ignored: "sys.UnraisableHookArgs") -> None:
        nonlocal timer
        global _interrupted
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            previous(ignored)
            return
        _interrupted = False
        # No thread can start at the end of the process.
        if not (timer and timer.is_alive()) and not sys.is_finalizing():
            timer = threading.Timer(DELAY, signal.pthread_kill, (main, signal.SIGINT))
            timer.start()

    sys.unraisablehook = repeat
