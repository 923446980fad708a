"""Ctrl-C that is not lost."""

import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

AGAIN_AFTER = 0.01  # seconds, in which the callback returns


class _Again:
    """What Python calls with errors that it ignores; interrupts come again."""

    def __init__(self, otherwise: Callable[["sys.UnraisableHookArgs"], Any]):
        self.otherwise = otherwise
        self.timer: threading.Timer | None = None

    def __call__(self, ignored: "sys.UnraisableHookArgs") -> None:
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            self.otherwise(ignored)
            return
        under_way = self.timer is not None and self.timer.is_alive()
        # At the end of the process no thread starts any more, and all is done.
        if not under_way and not sys.is_finalizing():
            main = threading.main_thread().ident
            self.timer = threading.Timer(AGAIN_AFTER, signal.pthread_kill, (main, signal.SIGINT))
            self.timer.start()


def keep_interrupts() -> None:
    """Raise a KeyboardInterrupt again where Python could only print it.

    In a callback of C code, such as Numba's when it loads a kernel, and in a finalizer, Python
    prints what is raised and goes on: Ctrl-C at such a moment would stop nothing.
    """
    sys.unraisablehook = _Again(sys.unraisablehook)
