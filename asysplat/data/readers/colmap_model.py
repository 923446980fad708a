"""Read the files of a COLMAP model, text and binary, and check that they are complete.

https://colmap.github.io/format.html
"""

import mmap
import re
import struct
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap

from asysplat.errors import InputError

CAMERA_MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
FILES = ("cameras", "images", "points3D", "rigs", "frames")
MAX_CAMERA = 24 + 8 * 16  # bytes of a camera in binary, with the parameters of the largest model
POINT_FIELDS = 8  # fields of a line of points3D.txt before its track
MAX_LINE = 2**26  # bytes of a line of text: a photograph with two million matches


def read_model(model: Path) -> pycolmap.Reconstruction:
    """Read a model; without its tracks, and with a warning, if these contradict its points."""
    binary = (model / "cameras.bin").is_file()
    files = _files(model, ".bin" if binary else ".txt")
    entries = {file: _entries(file) for file in files} if binary else {}
    for file in () if binary else files:
        check_lines(file)
    try:
        colmap = _read(model, binary)
    # Damaged files make COLMAP raise anything from IndexError to MemoryError, with a C++ trace.
    except Exception as error:
        reason = str(error).split("\n")[0]
        if reason == "Camera model does not exist":
            raise InputError(
                f"{model} has a camera model that is not known: undistort with colmap "
                f"image_undistorter, or use one of {', '.join(CAMERA_MODELS)}."
            ) from error
        try:
            with TemporaryDirectory() as folder:
                _write_without_tracks(files, Path(folder), entries)
                colmap = _read(Path(folder), binary)
        except Exception:
            raise InputError(
                f"{model} is not a complete COLMAP model ({reason}): copy its cameras, images and "
                "points3D files again."
            ) from error
        warnings.warn(
            f"the images and points of {model} contradict each other ({reason}): cameras and "
            "points are read without their matches.",
            stacklevel=2,
        )
    if binary:
        # COLMAP invents cameras beyond the file's end.
        expected = 8 + sum(24 + 8 * len(camera.params) for camera in colmap.cameras.values())
        size = (model / "cameras.bin").stat().st_size
        if size != expected:
            raise InputError(
                f"{model / 'cameras.bin'} has {size} bytes and its cameras take {expected}: it is "
                "cut short or damaged, so copy it again."
            )
    else:
        _check_count(model / "images.txt", colmap.num_images())
        _check_count(model / "points3D.txt", colmap.num_points3D())
    return colmap


def _files(model: Path, suffix: str) -> list[Path]:
    return [file for name in FILES if (file := model / f"{name}{suffix}").exists()]


def check_lines(file: Path) -> None:
    """Check that a text has no line so long that it is none of COLMAP's, which is read whole."""
    with file.open("rb") as parts:
        while part := parts.read(MAX_LINE):
            if len(part) == MAX_LINE and b"\n" not in part:
                raise InputError(
                    f"{file} has a line of over {MAX_LINE:,} bytes: it is damaged, so copy it "
                    "again."
                )


def _read(model: Path, binary: bool) -> pycolmap.Reconstruction:
    colmap = pycolmap.Reconstruction()
    (colmap.read_binary if binary else colmap.read_text)(model)
    [image.name for image in colmap.images.values()]  # raises UnicodeDecodeError
    return colmap


def _entries(file: Path) -> list[tuple[int, int]]:
    """Find the start of each entry of a binary file, and the end of it or of its fixed part.

    The fixed part of an image or a point ends before the count of its matches. COLMAP itself loops
    for ever in a file cut short.
    """
    entries, end = [], 8

    def number(kind: str, at: int) -> int:
        return struct.unpack_from(kind, stored, at)[0]

    def image(start: int) -> tuple[int, int]:
        fixed = stored.find(b"\0", start + 64) + 1  # after numbers and the name
        if fixed == 0:
            raise ValueError("a name has no end")
        return fixed, fixed + 8 + 24 * number("<Q", fixed)

    def point(start: int) -> tuple[int, int]:
        return start + 43, start + 51 + 8 * number("<Q", start + 43)

    def rig(start: int) -> tuple[int, int]:
        sensors = number("<I", start + 4)
        end = start + 8 + 8 * (sensors > 0)
        for _ in range(sensors - 1):
            end += 9 + 56 * number("<B", end + 8)  # with a pose or without
        return end, end

    def frame(start: int) -> tuple[int, int]:
        end = start + 68 + 16 * number("<I", start + 64)
        return end, end

    kinds = {"images.bin": image, "points3D.bin": point, "rigs.bin": rig, "frames.bin": frame}
    size = file.stat().st_size
    try:
        # Only what is asked for is read, however large the file.
        with (
            file.open("rb") as opened,
            mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as stored,
        ):
            count = number("<Q", 0)
            kind = kinds.get(file.name)  # none for cameras, whose size follows from their model
            if 8 * count > size or (kind is None and size > 8 + MAX_CAMERA * count):
                raise ValueError(f"its header gives {count} entries")
            if kind:
                for _ in range(count):
                    start = end
                    fixed, end = kind(start)
                    entries.append((start, fixed))
                if end != size:
                    raise ValueError(f"its entries take {end} bytes")
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(
            f"{file} has {size} bytes, but {error}: it is cut short or damaged, so copy it again."
        ) from error
    return entries


def _write_without_tracks(
    files: list[Path], folder: Path, entries: dict[Path, list[tuple[int, int]]]
) -> None:
    """Copy the files of a model without the matches of its images and the tracks of its points."""
    for file in files:
        if file.name in ("images.bin", "points3D.bin"):
            stored, empty = file.read_bytes(), bytes(8)
            parts = [stored[start:end] + empty for start, end in entries[file]]
            (folder / file.name).write_bytes(stored[:8] + b"".join(parts))
            continue
        if file.name in ("images.txt", "points3D.txt"):
            lines = file.read_bytes().decode("latin-1").split("\n")
            comments = [line for line in lines if line.startswith("#")]
            lines = [line for line in lines if not line.startswith("#")]
            if file.name == "images.txt":  # every second line has matches
                lines = [line for image in lines[::2] for line in (image, "")]
            else:
                lines = [" ".join(line.split()[:POINT_FIELDS]) for line in lines]
            (folder / file.name).write_bytes("\n".join((*comments, *lines)).encode("latin-1"))
            continue
        (folder / file.name).write_bytes(file.read_bytes())


def _check_count(file: Path, count: int) -> None:
    """Check the number of entries against the file's header; COLMAP accepts any number of lines."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        header = "".join(line for _, line in zip(range(4), lines, strict=False))
    expected = re.search(r"^# Number of \w+: (\d+)", header, re.MULTILINE)
    if expected and (expected[1].lstrip("0") or "0") != str(count):
        raise InputError(
            f"{file} holds {count} entries and its header gives {expected[1]}: it is cut short, so "
            "copy it again, or correct the header."
        )
