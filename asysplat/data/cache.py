"""A cache of photographs as they are used, undistorted and resized, in memory and on disk.

Both are bounded, and what was longest unused is removed first. The folder on disk is never inside a
data set.
"""

import os
import tempfile
import warnings
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray

GIGABYTE = 2**30
KEPT = 0.9  # of the limit, when a full disk cache is cleared


class ImageCache:
    """Arrays by key. A key names everything an array was made from, so no entry can be outdated.

    Processes may share the folder; each has memory of its own.

    Args:
        folder: on disk, made when first needed; null keeps nothing there.
        disk_gb, memory_gb: what each may take, in 2^30 bytes.
    """

    def __init__(
        self, folder: str | Path | None, disk_gb: int | float = 20, memory_gb: int | float = 0.5
    ):
        self.folder = None if folder is None else Path(folder).expanduser()
        self.disk_bytes, self.memory_bytes = disk_gb * GIGABYTE, memory_gb * GIGABYTE
        self._memory: OrderedDict[str, ndarray] = OrderedDict()
        self._in_memory = 0
        self._on_disk: int | None = None  # bytes when last counted, and what this process has added

    def get(self, key: str, make: Callable[[], ndarray], to_disk: bool) -> ndarray:
        """Return the array kept under `key`, else make and keep it; treat it as read-only."""
        if key in self._memory:
            self._memory.move_to_end(key)
            return self._memory[key]
        array = self._load(key) if to_disk else None
        if array is None:
            array = make()
            if to_disk:
                self._store(key, array)
        self._memory[key] = array
        self._in_memory += array.nbytes
        while self._in_memory > self.memory_bytes:
            self._in_memory -= self._memory.popitem(last=False)[1].nbytes
        return array

    def _file(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npy"

    def _load(self, key: str) -> ndarray | None:
        if self.folder is None:
            return None
        file = self._file(key)
        try:
            array = np.load(file, allow_pickle=False)
            os.utime(file)
        except (OSError, ValueError, EOFError):  # not there, or not whole
            return None
        return array

    def _store(self, key: str, array: ndarray) -> None:
        if self.folder is None:
            return
        if self._on_disk is None:
            self._on_disk = sum(size for _, size, _ in self._files())
        try:
            self._on_disk += _write(self._file(key), array)
        except OSError as error:
            warnings.warn(
                f"{self.folder} takes no more photographs ({error.strerror}): they are decoded "
                "again when they are needed.",
                stacklevel=2,
            )
            self.folder = None
        else:
            if self._on_disk > self.disk_bytes:
                self._clear()

    def _files(self) -> list[tuple[float, int, Path]]:
        """List the last use, the bytes and the path of every file on disk."""
        entries = []
        for file in self.folder.glob("*/*.npy"):
            try:
                stat = file.stat()
            except OSError:  # another process has cleared it
                continue
            entries.append((stat.st_mtime, stat.st_size, file))
        return entries

    def _clear(self) -> None:
        entries = sorted(self._files())
        self._on_disk = sum(size for _, size, _ in entries)
        for _, size, file in entries:
            if self._on_disk <= KEPT * self.disk_bytes:
                break
            file.unlink(missing_ok=True)
            self._on_disk -= size


def _write(file: Path, array: ndarray) -> int:
    """Write a file aside and put it in place whole: another process may be reading.

    Return its bytes.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    descriptor, aside = tempfile.mkstemp(dir=file.parent)
    try:
        with os.fdopen(descriptor, "wb") as handle:
            np.save(handle, array)
            size = handle.tell()
        os.replace(aside, file)
    except OSError:
        os.unlink(aside)
        raise
    return size
