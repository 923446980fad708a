"""The one error that users are meant to read."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one sentence that names the field or file, says what was found and what was
    expected, and how to fix it. Scripts print it alone, without a traceback.
    """


def input_error_behind(error: BaseException) -> InputError | None:
    """Return the InputError that `error` is or was raised from, else None.

    Hydra wraps the errors of the constructors that it calls.
    """
    seen: BaseException | None = error
    while seen is not None and not isinstance(seen, InputError):
        seen = seen.__cause__ or seen.__context__
    if seen is None:
        return None
    # A loader's worker puts its traceback before the sentence.
    return InputError(str(seen).rpartition(f"{InputError.__module__}.InputError: ")[2])
