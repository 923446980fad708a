"""Reader of prepared scenes: photographs as they are used, and their cameras, in one file.

root/<height>x<width>/<scene>.safetensors   written by `asysplat prepare`

A file holds `image`, the bytes of V encoded images one after the other, and `image_ends`, where
each of them ends; likewise `mask`, `alpha`, `depth` and `disparity`, if the scene has them. `lens`
is fx, fy, cx, cy in pixels, `cam_to_world` and `depth_unit` are those of PosedImage, `points` and
`origin` those of PosedScene.

https://huggingface.co/docs/safetensors/index#format
"""

import json
import math
import os
import re
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from weakref import finalize

import numpy as np
from numpy import ndarray

from asysplat.data.bad_images import BadImages
from asysplat.data.images import EncodedImage, Lens
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

SUFFIX = ".safetensors"
SIZE = re.compile(r"(\d+)x(\d+)")  # the name of a folder
DTYPES = {"F64": np.float64, "F32": np.float32, "I64": np.int64, "U8": np.uint8}


def find_scenes(root: Path) -> list[Path]:
    """Find the scenes of a prepared folder, as root/scene without their sizes; or a file's."""
    if root.suffix == SUFFIX and SIZE.fullmatch(root.parent.name) and root.is_file():
        return [root.parents[1] / root.stem]
    files = {file for folder in size_folders(root) for file in os.listdir(folder)}
    names = sorted(file.removesuffix(SUFFIX) for file in files if file.endswith(SUFFIX))
    return [root / name for name in names if not name.startswith(".")]  # unfinished files


def read_scene(scene: Path, bad: BadImages, size: tuple[int, int] | None = None) -> PosedScene:
    """Read a scene's file of a height and width, else of the largest; no image is read yet."""
    files = _files(scene)
    if not files:
        raise InputError(f"{scene} is no prepared scene: name one that asysplat prepare wrote.")
    return read_file(next((file for file in files if folder_size(file.parent) == size), files[-1]))


def read_file(file: Path) -> PosedScene:
    """Read the scene of one file."""
    stored = StoredTensors(file)
    height, width = folder_size(file.parent)
    lenses: dict[tuple[float, ...], Lens] = {}  # equal ones once
    rows = zip(
        *(stored.encoded(kind) for kind in ("image", "alpha", "mask", "depth", "disparity")),
        map(tuple, stored["lens"].tolist()),
        stored["cam_to_world"],
        stored["depth_unit"].tolist(),
        stored["held_out"].tolist(),
        strict=True,
    )
    images = []
    for image, alpha, mask, depth, disparity, lens, cam_to_world, depth_unit, held_out in rows:
        assert image is not None
        images.append(
            PosedImage(
                file=image,
                lens=lenses.setdefault(lens, Lens(width, height, *lens)),
                cam_to_world=cam_to_world,
                depth=depth,
                depth_unit=depth_unit,
                mask=alpha or mask,
                is_object=alpha is not None,
                held_out=bool(held_out),
                disparity=disparity,
            )
        )
    points = partial(stored.__getitem__, "points") if "points" in stored else None
    return PosedScene(file.stem, images, points, tuple(stored["origin"].tolist()))


class StoredTensors:
    """The tensors of a safetensors file, read when they are asked for.

    By offset and not through a memory map, for which the system reads far more than one image.
    """

    def __init__(self, file: Path):
        self.file = file
        length = int.from_bytes(_read(file, 0, 8), "little")
        self.entries = json.loads(_read(file, 8, length))
        self.metadata: dict[str, str] = self.entries.pop("__metadata__", {})
        self._begin = 8 + length

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def __getitem__(self, name: str) -> ndarray:
        entry = self.entries[name]
        start, end = entry["data_offsets"]
        stored = _read(self.file, self._begin + start, end - start)
        return np.frombuffer(stored, DTYPES[entry["dtype"]]).reshape(entry["shape"])

    def encoded(self, kind: str) -> Sequence[EncodedImage | None]:
        """Return the images of one kind, unread; None where there is none."""
        if kind not in self:
            return [None] * self.entries["lens"]["shape"][0]
        begin = self._begin + self.entries[kind]["data_offsets"][0]
        ends = [0, *self[f"{kind}_ends"].tolist()]
        return [
            EncodedImage(
                f"{self.file}, {kind} {i}", partial(_read, self.file, begin + start, end - start)
            )
            for i, (start, end) in enumerate(pairwise(ends))
        ]


def size_folders(root: Path) -> list[Path]:
    """List the folders of a prepared folder, one for each size, by their numbers of pixels."""
    if not root.is_dir():
        return []
    folders = [root / name for name in os.listdir(root) if SIZE.fullmatch(name)]
    return sorted(folders, key=lambda folder: math.prod(folder_size(folder)))


def folder_size(folder: Path) -> tuple[int, int]:
    """Return the height and width that a folder is named after."""
    height, width = folder.name.split("x")
    return int(height), int(width)


def _files(scene: Path) -> list[Path]:
    files = (folder / f"{scene.name}{SUFFIX}" for folder in size_folders(scene.parent))
    return [file for file in files if file.is_file()]


def _read(file: Path, start: int, size: int) -> bytes:
    stored = os.pread(_opened(file).descriptor, size, start)
    if len(stored) < size:
        raise InputError(f"{file} ends too early: write it again with asysplat prepare --verify.")
    return stored


class _OpenFile:
    def __init__(self, file: Path):
        self.descriptor = os.open(file, os.O_RDONLY)
        finalize(self, os.close, self.descriptor)
        if hasattr(os, "posix_fadvise"):  # so that the system does not read ahead
            os.posix_fadvise(self.descriptor, 0, 0, os.POSIX_FADV_RANDOM)


@lru_cache(maxsize=16)
def _opened(file: Path) -> _OpenFile:
    return _OpenFile(file)
