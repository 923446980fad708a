"""Messages to users: the error of invalid input, and plain warnings."""

import warnings
from collections.abc import Collection

MAX_NAMES = 5  # names in a message
MAX_CHARACTERS = 500  # of another error's in a message


class InputError(ValueError):
    """Invalid input of a user.

    The message is one sentence: the field or file, what was found, what is expected, and how to fix
    it. Scripts print it without a traceback.
    """


def list_names(names: Collection[str]) -> str:
    """List the first names in order, for a message."""
    return ", ".join(sorted(names)[:MAX_NAMES]) + ", ..." * (len(names) > MAX_NAMES)


def input_error_behind(error: BaseException) -> InputError | None:
    """Return the InputError that `error` is or was raised from, or None.

    Hydra wraps the errors of constructors that it calls.
    """
    seen: BaseException | None = error
    while seen is not None and not isinstance(seen, InputError):
        seen = cause_of(seen)
    if seen is None:
        return None
    # Data-loader workers prepend their traceback.
    return InputError(str(seen).rpartition(f"{InputError.__module__}.InputError: ")[2])


def cause_of(error: BaseException) -> BaseException | None:
    """Return the error that `error` was raised from, or while it was handled."""
    return error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def brief(error: BaseException) -> str:
    """Return the class and the first line of an error, for a message."""
    return repr(error.__cause__ or error).split("\\n")[0][:MAX_CHARACTERS]


def plain_warnings() -> None:
    """Print warnings as one line, without their line of code."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
