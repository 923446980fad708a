"""Folders of COLMAP: photographs, their masks, and a model of their cameras."""

import hashlib
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap
from PIL import Image, ImageOps
from PIL.ExifTags import Base
from rich.console import Console
from rich.progress import Progress

from asysplat.data.images import HEIF, ImageFile, image_size, load_mask
from asysplat.data.readers.additions import MASKS
from asysplat.data.readers.common import check_map_size
from asysplat.files import check_room, make_folder

ERRORS = "errors.json"  # file of the errors of refined cameras
KEPT = ("images", MASKS, ERRORS)
JPEG_QUALITY = 95
BYTES_PER_PHOTOGRAPH = 10_000_000  # features and matches take up to 4 MB, and a copy as much
ONLY_FATAL = 3  # the least severe messages that are printed


@contextmanager
def work_folder(
    where: Path, photographs: int, console: Console | None
) -> Generator[tuple[Path, Progress]]:
    """Yield a temporary folder in `where` with images/, and progress bars; quiet COLMAP."""
    make_folder(where, "paths.logs")
    check_room(where, photographs * BYTES_PER_PHOTOGRAPH)  # without it, COLMAP ends the process
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, ONLY_FATAL
    try:
        with (
            TemporaryDirectory(dir=where) as work,
            Progress(console=console, transient=True, disable=console is None) as progress,
        ):
            (Path(work) / "images").mkdir()
            yield Path(work), progress
    finally:
        pycolmap.logging.minloglevel = before


def digest(method: str, files: Iterable[Path]) -> str:
    """Return a name that follows from files, from where they are, and from the method."""
    result = hashlib.sha256(f"{method} {pycolmap.__version__}".encode())
    for path in files:
        result.update(f"{path}\0".encode())
        with path.open("rb") as file:
            result.update(hashlib.file_digest(file, "sha256").digest())
    return result.hexdigest()[:12]


def colmap_names(files: Iterable[Path]) -> dict[Path, str]:
    """Return a name of each file for COLMAP, which separates names by spaces and reads no HEIF."""
    names: dict[Path, str] = {}
    for file in files:
        name = "_".join(file.name.split()) + ".jpg" * (file.suffix.lower() in HEIF)
        while name in names.values():
            name = f"_{name}"
        names[file] = name
    return names


def link_photograph(file: Path, link: Path, upright: bool = False) -> None:
    """Link to a photograph; copy it where COLMAP cannot read it, or it is to be turned upright."""
    with Image.open(file) as image:
        turned = upright and image.getexif().get(Base.Orientation, 1) != 1
        if file.suffix.lower() not in HEIF and not turned:
            link.symlink_to(file)
            return
        if turned:
            image = ImageOps.exif_transpose(image)
        image.save(link, exif=image.getexif(), quality=JPEG_QUALITY)


def save_mask(mask: ImageFile | None, image: Path) -> None:
    """Write the mask of images/NAME, if there is one, to masks/NAME.png beside."""
    if mask is None:
        return
    size = image_size(image)
    kept = Image.fromarray(load_mask(check_map_size(mask, size, str(image))))
    target = image.parents[1] / MASKS / f"{image.name}.png"
    target.parent.mkdir(exist_ok=True)
    kept.resize(size, Image.Resampling.NEAREST).convert("L").save(target)


def keep(work: Path, model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model and move it, with what a work folder has of KEPT, to a new folder."""
    result = work / "result"
    (result / "sparse" / "0").mkdir(parents=True)
    model.write(result / "sparse" / "0")
    for name in KEPT:
        if (work / name).exists():
            (work / name).rename(result / name)
    result.rename(folder)
