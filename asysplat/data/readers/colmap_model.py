"""Read the files of a COLMAP model, text or binary.

https://colmap.github.io/format.html
"""

import re
import struct
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap

from asysplat.errors import InputError

CAMERA_MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
POINT_FIELDS = 8  # fields of a line of points3D.txt before its track
# Of an entry of a binary file: where it counts what follows, the type of the count, bytes of each.
COUNTS = {"points3D.bin": (43, "<Q", 8), "frames.bin": (64, "<I", 16)}


def read_model(model: Path) -> pycolmap.Reconstruction:
    """Read a model; without its tracks, and with a warning, if a text's contradict its points."""
    binary = (model / "cameras.bin").is_file()
    for name in COUNTS if binary else ():
        if (model / name).exists():
            _check_whole(model / name)
    try:
        colmap = _read(model)
    except Exception as error:  # errors of any kind, from IndexError to MemoryError
        reason = str(error).split("\n")[0]
        if reason == "Camera model does not exist":
            raise InputError(
                f"{model} has a camera model that is not known: undistort with colmap "
                f"image_undistorter, or use one of {', '.join(CAMERA_MODELS)}."
            ) from error
        try:
            with TemporaryDirectory() as folder:
                _write_without_tracks(model, Path(folder))
                colmap = _read(Path(folder))
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
        if (model / "cameras.bin").stat().st_size != expected:
            raise InputError(f"{model / 'cameras.bin'} is cut short: copy it again.")
    else:
        _check_count(model / "images.txt", colmap.num_images())
        _check_count(model / "points3D.txt", colmap.num_points3D())
    return colmap


def _read(model: Path) -> pycolmap.Reconstruction:
    colmap = pycolmap.Reconstruction(model)
    [image.name for image in colmap.images.values()]  # raises UnicodeDecodeError
    return colmap


def _check_whole(file: Path) -> None:
    """Check that a binary file has all its entries: COLMAP loops for ever in one cut short."""
    offset, kind, each = COUNTS[file.name]
    stored, end = file.read_bytes(), 8
    try:
        for _ in range(struct.unpack_from("<Q", stored)[0]):
            (count,) = struct.unpack_from(kind, stored, end + offset)
            end += offset + struct.calcsize(kind) + each * count
    except struct.error:
        end = -1
    if end != len(stored):
        raise InputError(f"{file} is cut short: copy it again.")


def _write_without_tracks(model: Path, folder: Path) -> None:
    """Copy a text model without the matches of its images and the tracks of its points."""
    for file in model.glob("*.txt"):
        lines = file.read_text(encoding="utf-8").split("\n")
        comments = [line for line in lines if line.startswith("#")]
        lines = [line for line in lines if not line.startswith("#")]
        if file.name == "images.txt":  # every second line has matches
            lines = [line for image in lines[::2] for line in (image, "")]
        elif file.name == "points3D.txt":
            lines = [" ".join(line.split()[:POINT_FIELDS]) for line in lines]
        (folder / file.name).write_text("\n".join((*comments, *lines)), encoding="utf-8")


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
