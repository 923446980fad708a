"""A cache of undistorted and resized images, in memory and on disk.

Both are bounded; the least recently used arrays are removed first. The folder on disk is never
inside a data set.
"""

import os
import re
import tempfile
import warnings
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy import ndarray

GIGABYTE = 2**30
KEY = re.compile("[0-9a-f]{32}-[0-9a-f]{16}")  # keys of images, see FileSequence
FILL_AFTER_CLEARING = 0.9  # fraction of the limit to which a full disk cache is cleared


class ImageCache:
    """Arrays by key. A key covers everything an array is made from, so no entry can be outdated.

    Processes may share the folder, which is made at the first write; each has memory of its own.
    The limits are in 2^30 bytes.
    """

    def __init__(
        self, folder: str | Path | None, disk_gb: int | float = 20, memory_gb: int | float = 0.5
    ):
        self.folder = None if folder is None else Path(folder).expanduser()
        self.disk_bytes, self.memory_bytes = disk_gb * GIGABYTE, memory_gb * GIGABYTE
        self._memory: OrderedDict[str, ndarray] = OrderedDict()
        self._in_memory = 0
        self._on_disk: int | None = None  # bytes when last counted, plus this process's writes

    def get(self, key: str, make: Callable[[], ndarray], to_disk: bool) -> ndarray:
        """Return the array under `key`, else make and store it; treat it as read-only."""
        if key in self._memory:
            self._memory.move_to_end(key)
            return self._memory[key]
        file = self.folder / key[:2] / f"{key}.npy" if to_disk and self.folder else None
        array = _read(file) if file else None
        if array is None:
            array = make()
            if file:
                self._store(file, array)
        self._memory[key] = array
        self._in_memory += array.nbytes
        while self._in_memory > self.memory_bytes:
            self._in_memory -= self._memory.popitem(last=False)[1].nbytes
        return array

    def _store(self, file: Path, array: ndarray) -> None:
        if self._on_disk is None:
            self._on_disk = sum(size for _, size, _ in _files(file.parents[1]))
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            # Atomic, since another process may be reading.
            descriptor, partial = tempfile.mkstemp(dir=file.parent)
            try:
                with os.fdopen(descriptor, "wb") as handle:
                    np.save(handle, array)
                    self._on_disk += handle.tell()
                os.replace(partial, file)
            except OSError:
                os.unlink(partial)
                raise
        except OSError as error:
            warnings.warn(
                f"{self.folder} cannot store more images ({error.strerror}): they are decoded "
                "again when they are needed.",
                stacklevel=2,
            )
            self.folder = None
            return
        if self._on_disk <= self.disk_bytes:
            return
        entries = sorted(_files(file.parents[1]))
        self._on_disk = sum(size for _, size, _ in entries)
        for _, size, file in entries:
            if self._on_disk <= FILL_AFTER_CLEARING * self.disk_bytes:
                break
            file.unlink(missing_ok=True)
            self._on_disk -= size


def _files(folder: Path) -> list[tuple[float, int, Path]]:
    """List the last use, the bytes and the path of every array on disk."""
    entries = []
    for file in folder.glob("*/*.npy"):
        if not KEY.fullmatch(file.stem) or file.parent.name != file.stem[:2]:
            continue  # it is not the cache's to remove
        with suppress(OSError):  # another process has cleared it
            stat = file.stat()
            entries.append((stat.st_mtime, stat.st_size, file))
    return entries


def _read(file: Path) -> ndarray | None:
    """Read a file and mark it as used; None if it is missing or damaged."""
    try:
        os.utime(file)
        return np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
