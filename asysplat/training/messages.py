"""The messages of a script: errors as one sentence, warnings without their line of code."""

import errno
import logging
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from asysplat.errors import input_error_behind, plain_warnings

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def quiet_lightning() -> None:
    """Hide Lightning's tips and deprecations; print other warnings without their line of code."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    plain_warnings()


@contextmanager
def exit_with_message(stopped: str) -> Iterator[None]:
    """End the process with the sentence `stopped` at Ctrl-C, or that of `error_sentence`."""
    try:
        yield
    except BaseException as error:
        # A second Ctrl-C would abort the interpreter, a lost loader print a traceback.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        if isinstance(error, KeyboardInterrupt):
            sys.exit(stopped)
        # An exit has its message already.
        sentence = None if isinstance(error, SystemExit) else error_sentence(error)
        if sentence is None:
            raise
        sys.exit(f"error: {sentence}")


def error_sentence(error: BaseException) -> str | None:
    """Return the sentence of an InputError, a full disk or a lost loader; None for other errors.

    `error` may also have been raised from one of them.
    """
    mistake = input_error_behind(error)
    if mistake is not None:
        return str(mistake)
    each: BaseException | None = error
    while each is not None:
        if isinstance(each, OSError) and each.errno in NO_SPACE:
            place = f" for {each.filename}" if each.filename else ""
            return f"there is no space on the disk{place} ({each.strerror}): free some."
        if isinstance(each, RuntimeError) and str(each).startswith("DataLoader worker"):
            return (
                f"a process that loads data was lost ({each}); if memory was short, set "
                "data.num_workers lower."
            )
        each = each.__cause__ or each.__context__
    return None
