"""Files that are there whole or not at all: written aside, then moved into place."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from asysplat.errors import InputError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary path to write to, in the same folder; move it to `path` at the end.

    The file is on the disk before it is moved. Whatever is raised meanwhile, a KeyboardInterrupt
    too, leaves `path` as it was and no temporary file behind.

    Raises:
        InputError: the file cannot be written: no such folder, not allowed, a full disk.
    """
    target = Path(path).resolve()  # behind a link, so that the link stays
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
        # Of another file, from which is read what is written here.
        if error.filename is not None and str(error.filename) != str(partial):
            raise
        raise InputError(
            f"{path} cannot be written ({error.strerror or error}): name a folder that is there, "
            "that you may write to and that has room; what was there before is unchanged."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
