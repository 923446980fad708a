"""The one error that users are meant to read."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one sentence that names the field or file, says what was found and what was
    expected, and how to mend it. Scripts print it alone, without a traceback.
    """
