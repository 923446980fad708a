"""Ctrl-C that is not lost."""

import signal
import sys
import threading

AGAIN_AFTER = 0.01  # seconds, in which the callback returns


def keep_interrupts() -> None:
    """Raise a KeyboardInterrupt again where Python could only print it.

    In a callback of C code, such as Numba's when it loads a kernel, and in a finaliser, Python
    prints what is raised and goes on: Ctrl-C at such a moment would stop nothing.
    """
    otherwise = sys.unraisablehook

    def again(ignored: "sys.UnraisableHookArgs") -> None:
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            otherwise(ignored)
        elif not sys.is_finalizing():  # then all is done, and no thread starts any more
            main = threading.main_thread().ident
            threading.Timer(AGAIN_AFTER, signal.pthread_kill, (main, signal.SIGINT)).start()

    sys.unraisablehook = again
