"""Messages to users: the error of invalid input, and plain warnings."""

import warnings
from collections.abc import Collection
from typing import Any

MAX_NAMES = 5  # names in a message
MAX_CHARACTERS = 500  # of another error's in a message


class InputError(ValueError):
    """Invalid input of a user, in a sentence, which scripts print without a traceback.

    It says the field or file, what was found, what is expected, and how to fix it.
    """


def list_names(names: Collection[str]) -> str:
    """List the first names in order, for a message."""
    return ", ".join(sorted(names)[:MAX_NAMES]) + ", ..." * (len(names) > MAX_NAMES)


def input_error_behind(error: BaseException) -> InputError | None:
    """Return the InputError that `error` is or was raised from, by Hydra or pydantic, or None."""
    seen: BaseException | None = error
    while seen is not None and not isinstance(seen, InputError):
        if type(seen).__name__ == "ValidationError":  # by name: pydantic may not be loaded
            return first_mistake(seen)
        seen = cause_of(seen)
    if seen is None:
        return None
    # Data-loader workers prepend their traceback.
    return InputError(str(seen).rpartition(f"{InputError.__module__}.InputError: ")[2])


def first_mistake(error: Any, title: str | None = None) -> InputError:
    """Return the first mistake of a ValidationError as a sentence; `title` names its option."""
    first = error.errors()[0]
    if "error" in first.get("ctx", {}):  # raised by a dataclass itself
        return InputError(str(first["ctx"]["error"]))
    name = ".".join(map(str, (title or error.title, *first["loc"])))
    value, words = "null" if first["input"] is None else first["input"], first["msg"]
    words = words.removeprefix("Input") if words.startswith("Input") else f": {words}"
    return InputError(f"{name}={value}{words}.")


def cause_of(error: BaseException) -> BaseException | None:
    """Return the error that `error` was raised from, or while it was handled."""
    return error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def brief(error: BaseException) -> str:
    """Return the class and the first line of an error, for a message."""
    return repr(error.__cause__ or error).split("\\n")[0][:MAX_CHARACTERS]


def plain_warnings() -> None:
    """Print warnings as one line, without their line of code."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
