"""Atomic writes: to a temporary file, which is then moved into place."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from asysplat.errors import InputError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder to write to, then move it to `path`.

    The file is synced to disk before. Any exception, KeyboardInterrupt too, leaves `path` unchanged
    and no temporary file.

    Raises:
        InputError: the file cannot be written: no such folder, no permission, a full disk.
    """
    target = Path(path).resolve()  # keeps a symbolic link
    if target.exists() and not target.is_file():
        raise InputError(f"{path} is a folder or a device: name a file.")
    partial = target.with_name(f".{target.stem}.{uuid4().hex[:8]}{target.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, partial)
        os.replace(partial, target)
    except OSError as error:
        # The error of another file, which is read meanwhile.
        if error.filename is not None and str(error.filename) != str(partial):
            raise
        raise InputError(
            f"{path} cannot be written ({error.strerror or error}): name an existing folder "
            "that you may write to and that has room; a previous file is unchanged."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
