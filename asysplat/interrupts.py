"""Keep KeyboardInterrupts that Python would ignore."""

import signal
import sys
import threading

DELAY = 0.01  # seconds until the callback has returned


def keep_interrupts() -> None:
    """Repeat a KeyboardInterrupt that Python can only print.

    In a finalizer, or a callback of C code (such as Numba's when it loads a kernel), Python prints
    exceptions and continues: Ctrl-C at such a moment would be lost.
    """
    previous, main = sys.unraisablehook, threading.main_thread().ident
    timer: threading.Timer | None = None

    def repeat(ignored: "sys.UnraisableHookArgs") -> None:
        nonlocal timer
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            previous(ignored)
        # No thread can start at the end of the process.
        elif not (timer and timer.is_alive()) and not sys.is_finalizing():
            timer = threading.Timer(DELAY, signal.pthread_kill, (main, signal.SIGINT))
            timer.start()

    sys.unraisablehook = repeat
