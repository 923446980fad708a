"""Keep KeyboardInterrupts that Python would ignore."""

import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

DELAY = 0.01  # seconds until the callback has returned


class _RepeatInterrupts:
    """Hook for ignored errors that repeats interrupts."""

    def __init__(self, previous: Callable[["sys.UnraisableHookArgs"], Any]):
        self.previous = previous
        self.timer: threading.Timer | None = None

    def __call__(self, ignored: "sys.UnraisableHookArgs") -> None:
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            self.previous(ignored)
            return
        pending = self.timer is not None and self.timer.is_alive()
        # No thread can start at the end of the process.
        if not pending and not sys.is_finalizing():
            main = threading.main_thread().ident
            self.timer = threading.Timer(DELAY, signal.pthread_kill, (main, signal.SIGINT))
            self.timer.start()


def keep_interrupts() -> None:
    """Repeat a KeyboardInterrupt that Python can only print.

    In a finalizer, or a callback of C code (such as Numba's when it loads a kernel), Python prints
    exceptions and continues: Ctrl-C at such a moment would be lost.
    """
    sys.unraisablehook = _RepeatInterrupts(sys.unraisablehook)
