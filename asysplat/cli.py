"""How a script begins and ends: options checked before it loads, signals, errors in a sentence."""

import errno
import functools
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import hydra
from hydra._internal.utils import get_args_parser
from omegaconf import DictConfig, OmegaConf

from asysplat.errors import cause_of, input_error_behind, plain_warnings
from asysplat.interrupts import end_at_interrupt, handle_signals, interrupt_once
from asysplat.overrides import check_overrides, quote_paths
from asysplat.root import CONF, ROOT, typed

OmegaConf.register_new_resolver("typed", typed, replace=True)  # in the texts of --help
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_command(script: str) -> DictConfig | None:
    """Check this process's command line and compose it; exit with the message on an error.

    A script calls it before it imports torch, which takes seconds. Ctrl-C then ends the process. A
    configuration of another folder is left to Hydra: None.
    """
    end_at_interrupt()
    os.environ.setdefault("ASYSPLAT_SHARED", str(ROOT.parent / "shared"))
    sys.argv[1:] = quote_paths(sys.argv[1:])
    args = get_args_parser().parse_args()
    if args.help:  # what Hydra prints, without the second that composing takes
        print(OmegaConf.load(CONF / f"{script}.yaml").hydra.help.template)
        sys.exit()
    if args.hydra_help or args.shell_completion:
        hydra.main(config_path=str(CONF), config_name=script, version_base="1.3")(lambda _: None)()
        sys.exit()
    if args.config_dir or args.config_name or args.config_path:
        return None
    with exit_with_message("stopped."):
        return check_overrides(args.overrides, script)


def command(
    script: str, stopped: str = "stopped."
) -> Callable[[Callable[[DictConfig], object]], Callable[[], object]]:
    """Return a decorator that makes a function of conf/<script>.yaml the command of a script."""

    def decorate(function: Callable[[DictConfig], object]) -> Callable[[], object]:
        @hydra.main(config_path=str(CONF), config_name=script, version_base="1.3")
        @functools.wraps(function)
        def run(config: DictConfig) -> object:
            with exit_with_message(stopped):
                return function(config)

        @functools.wraps(function)
        def main() -> object:
            handle_signals()
            interrupt_once()
            plain_warnings()
            with exit_with_message(stopped):
                return run()

        return main

    return decorate


@contextmanager
def exit_with_message(stopped: str) -> Iterator[None]:
    """End the process with the message `stopped` at Ctrl-C, or with that of `error_message`."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        message = stopped
        if not isinstance(error, KeyboardInterrupt):
            if (summary := error_message(error)) is None:
                raise
            message = f"error: {summary}"
        # A second Ctrl-C would abort the interpreter, a lost loader print a traceback.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        sys.exit(message)


def error_message(error: BaseException) -> str | None:
    """Return a sentence for an InputError, a full disk or memory, or a lost process; else None."""
    if (mistake := input_error_behind(error)) is not None:
        return str(mistake)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in NO_SPACE:
            place = f" for {cause.filename}" if cause.filename else ""
            return f"there is no space on the disk{place} ({cause.strerror}): free some."
        if isinstance(cause, RuntimeError) and str(cause).startswith("DataLoader worker"):
            return (
                f"a process that loads data was lost ({cause}); if memory was short, set "
                "data.num_workers lower."
            )
        if _is_lost_connection(cause):
            return (
                "the connection to another process of this training was lost: see what ended that "
                "process, above or in its own output."
            )
        if _is_out_of_memory(cause):
            # Without torch's line of source before, and the state of its memory after.
            reason = str(cause).rpartition("DefaultCPUAllocator: ")[2]
            reason = re.split(r"\. (?:GPU|Error code)", reason)[0]
            return (
                f"there is no memory left ({reason or 'no reason given'}): choose fewer or smaller "
                "views, fewer Gaussians or a smaller batch; docs/options.md names the options."
            )
        cause = cause_of(cause)
    return None


def _is_lost_connection(error: BaseException) -> bool:
    message = str(error)  # errors of their set-up, such as a port in use, have the same types
    words = ("reset by peer", "closed by peer", "Broken pipe")
    by_gloo = "gloo" in message and any(word in message for word in words)
    return by_gloo or "remote process exited" in message


def _is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error is Python's, the system's or torch's for too little memory."""
    # By name: torch may not be loaded. Its CPU allocator and Python's threads raise RuntimeError.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    words = ("DefaultCPUAllocator: can't allocate memory", "can't start new thread")
    return isinstance(error, RuntimeError) and any(word in str(error) for word in words)
