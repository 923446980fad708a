"""Reading that ends, and writing that loses nothing: atomic writes, own folders."""

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from typing import Any
from uuid import uuid4

from asysplat.errors import InputError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder to write to, then move it to `path`.

    Any exception, KeyboardInterrupt too, leaves `path` unchanged and no temporary file. A link is
    replaced, and what it names stays.
    """
    target = Path(path).absolute()
    if target.exists() and not target.is_file():
        raise InputError(f"{path} is a folder or a device: name a file.")
    partial = target.with_name(f".{target.stem}.{uuid4().hex[:8]}{target.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists() and not target.is_symlink():
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


def make_folder(path: Path, option: str) -> None:
    """Create a folder if there is none."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        reason = None if os.access(path, os.W_OK) else os.strerror(errno.EACCES)
    except OSError as error:
        reason = error.strerror
    if reason is not None:
        raise InputError(f"{path} cannot be written to ({reason}): set {option} to another folder.")


def check_exists(path: Path, expected: str) -> None:
    """Check that a path exists; `expected` says what to name instead."""
    if not path.exists():
        raise InputError(f"{path} does not exist: name {expected}.")


def read_text(path: Path) -> str:
    """Read UTF-8 text, with or without a byte order mark."""
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): write it again.") from error


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    if not path.exists():
        raise InputError(f"{path} does not exist: put it there, or name another file.")
    text = read_text(path)
    if not text.strip():
        raise InputError(f"{path} is empty: write it again.")
    try:
        return json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}): repair or write it again.") from error


def refuse_links(folder: Path) -> None:
    """Check that a folder holds no symbolic links, through which one would write elsewhere."""
    for place, folders, files in os.walk(folder):
        for path in (Path(place) / name for name in (*folders, *files)):
            if path.is_symlink():
                raise InputError(
                    f"{path} is a link, and {folder} is written to: put what it names in its "
                    "place, or remove it."
                )


def check_writable(path: Path, option: str) -> None:
    """Check that a folder is, or can be created, writable; leave the disk as it is."""
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        make_folder(path, option)
    finally:
        for folder in missing:
            with suppress(OSError):  # never created, or another process writes there
                folder.rmdir()


def check_room(folder: Path, room: int) -> None:
    """Check that the disk of a folder has `room` bytes of free space."""
    free = shutil.disk_usage(folder).free
    if free < room:
        raise InputError(
            f"{folder} has {free / 1e6:.0f} MB of free space, and the results may take "
            f"{room / 1e6:.0f} MB: free some, or set paths.logs to a folder on another disk."
        )


def new_folder(path: Path) -> Path:
    """Create a folder that was not there: `path`, or else `path`-2, -3, ..."""
    make_folder(path.parent, "paths.logs")
    for folder in chain([path], (path.with_name(f"{path.name}-{n}") for n in count(2))):
        try:
            folder.mkdir()  # only one of two processes succeeds
            return folder
        except OSError:
            make_folder(folder, "paths.logs")  # raises unless there is one
    raise AssertionError
