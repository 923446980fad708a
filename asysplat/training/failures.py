"""What ended a run, as a sentence, where it is no mistake of the code."""

import errno
from collections.abc import Iterator

from asysplat.errors import input_error_behind

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def sentence_of(error: BaseException) -> str | None:
    """Return the sentence of an InputError, a full disk or a lost loader; None for other errors.

    It may be what `error` was raised from.
    """
    mistake = input_error_behind(error)
    if mistake is not None:
        return str(mistake)
    for each in _chain(error):
        if isinstance(each, OSError) and each.errno in NO_ROOM:
            place = f" for {each.filename}" if each.filename else ""
            return f"there is no room on the disk{place} ({each.strerror}): make some."
        if isinstance(each, RuntimeError) and str(each).startswith("DataLoader worker"):
            return (
                f"a process that loads data was lost ({each}); if memory was short, set "
                "data.num_workers lower."
            )
    return None


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and those that it was raised from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
