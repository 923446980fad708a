"""Find the cameras of photographs or of a video: structure from motion.

python -m asysplat.data.cameras my_photographs

With COLMAP (Schönberger & Frahm 2016, Structure-from-Motion Revisited), by pycolmap. Nothing is
written beside the photographs: the cameras go to a folder of their own in COLMAP's layout, with
links to the photographs, and the next call with the same photographs returns it at once.
"""

import hashlib
import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pycolmap
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from rich.console import Console
from rich.progress import Progress

from asysplat.data.bad_images import BadImages, Policy
from asysplat.data.frames import save_sharp_frames
from asysplat.data.images import image_size
from asysplat.data.readers import photographs_in, without_cameras
from asysplat.data.write import refuse_inside
from asysplat.errors import InputError
from asysplat.files import make_folder

MIN_FOUND = 0.25  # share of the photographs; with fewer there is no scene
ENOUGH = 0.9  # share of the photographs; with fewer the next attempt is made
LEAST_PHOTOGRAPHS = 3
ALL_PAIRS = 80  # photographs; of more, not all pairs are matched but
FOLLOWING = 10  # each with so many that follow, and with those 16, 32, ... further on,
ANCHORS = 40  # and so many, spread evenly, with each other: a sequence may return to a place
CHUNK = 8  # photographs, or that squared of pairs, between two updates of the progress bar
SEED = 0
ONLY_FATAL = 3  # the least severe messages that are printed


@dataclass(frozen=True)
class Attempt:
    """How hard features and matches are sought.

    Args:
        max_side: pixels of the longer side; larger images are shrunk to find features.
        features: greatest number of features in an image.
        contrast: least contrast of a feature.
        guided: whether matches are sought again along epipolar lines.
        pair, first_pair, image: least number of inliers of a pair, of the pair to start with, and
            of an image that is added.
        angle: least angle between the rays of the pair to start with, in degrees.
    """

    max_side: int
    features: int
    contrast: float
    guided: bool
    pair: int
    first_pair: int
    image: int
    angle: float


ATTEMPTS = (
    Attempt(1600, 4096, 0.0067, guided=False, pair=15, first_pair=100, image=30, angle=16.0),
    Attempt(3200, 8192, 0.002, guided=True, pair=10, first_pair=50, image=15, angle=4.0),
)


def find_cameras(
    photographs: Path | str,
    where: Path | str,
    frames: int = 100,
    on_bad_image: Policy = "fail",
    console: Console | None = None,
) -> Path:
    """Find the cameras of photographs or of a video; return a folder in COLMAP's layout.

    Its images/ are links to the photographs, upright copies of those that are stored turned, or the
    frames of a video; its sparse/0 has the cameras and the points they were found with. A second
    attempt with weaker features follows where the first finds fewer than 9 of 10 cameras; the
    better one is returned.

    Args:
        photographs: a folder of photographs of one place, or of an images/ with them; or a video.
        where: the folder is made in it, named by the content of the photographs.
        frames: greatest number of frames of a video, each the sharpest of an equal part.
        on_bad_image: "fail", or "skip" to leave out photographs that cannot be read.
        console: where progress is shown; None shows none.

    Raises:
        InputError: no photographs without poses, fewer than 3 `frames`, a photograph that cannot be
            read, `where` cannot be written to, or too few that show the same place.
    """
    source, where = Path(photographs).absolute(), Path(where).absolute()
    if without_cameras(source) is None:
        raise InputError(
            f"{photographs} is no folder of photographs without cameras, and no video: name one."
        )
    if not isinstance(frames, int) or frames < LEAST_PHOTOGRAPHS:
        raise InputError(f"frames={frames}: give a whole number of at least {LEAST_PHOTOGRAPHS}.")
    files = [source] if source.is_file() else photographs_in(source)
    lenses = {} if source.is_file() else _lenses(files, source, on_bad_image)
    folder = where / f"{source.stem}-{_digest(files, frames)}"
    if folder.is_dir():
        return folder
    make_folder(where, "paths.logs")
    with (
        _quiet_colmap(),
        TemporaryDirectory(dir=where) as work,
        Progress(console=console, transient=True, disable=console is None) as progress,
    ):
        images = Path(work) / "images"
        images.mkdir()
        if source.is_file():
            save_sharp_frames(source, images, frames, progress)
            lenses = _lenses(photographs_in(images), source, on_bad_image)
        names = {}
        for file, lens in lenses.items():
            name = "_".join(file.name.split())  # COLMAP separates names by spaces
            while name in names:
                name = f"_{name}"
            if file.parent != images:
                _link_upright(file, images / name)
            names[name] = lens
        model = _best_model(Path(work), images, names, progress)
        if _registered(model) < max(LEAST_PHOTOGRAPHS, MIN_FOUND * len(names)):
            raise InputError(
                f"{photographs}: found cameras for {_registered(model)} of {len(names)} "
                "photographs: too few show the same place; photograph it with more overlap, from "
                "different places."
            )
        result = Path(work) / "result"
        (result / "sparse" / "0").mkdir(parents=True)
        model.write(result / "sparse" / "0")
        images.rename(result / "images")
        result.rename(folder)
    return folder


def _lenses(files: Sequence[Path], source: Path, on_bad_image: Policy) -> dict[Path, tuple]:
    """Return for each photograph what tells its camera from others."""
    if len(files) < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"{source} has {len(files)} photographs without camera poses: cameras are found from "
            f"at least {LEAST_PHOTOGRAPHS} that overlap."
        )
    bad = BadImages(on_bad_image)
    lenses = dict(bad.read_each(lambda file: (file, _lens_of(file)), ((file,) for file in files)))
    bad.report(str(source), len(lenses))
    return lenses


def _lens_of(file: Path) -> tuple:
    """Return the size upright, and the make, model and focal length that the file names."""
    size = image_size(file)
    with Image.open(file) as image:
        exif = image.getexif()
        details = exif.get_ifd(IFD.Exif)
    turned = exif.get(Base.Orientation, 1) >= 5
    focal = details.get(Base.FocalLength), details.get(Base.FocalLengthIn35mmFilm)
    return (size[::-1] if turned else size, exif.get(Base.Make), exif.get(Base.Model), *focal)


def _digest(files: Sequence[Path], frames: int) -> str:
    """Return a name that follows from the photographs, from where they are, and from the method."""
    digest = hashlib.sha256(f"{ATTEMPTS} {frames} {pycolmap.__version__}".encode())
    for path in files:
        digest.update(f"{path}\0".encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:12]


def _link_upright(file: Path, link: Path) -> None:
    """Link to a photograph; copy it where its pixels are stored turned."""
    with Image.open(file) as image:
        if image.getexif().get(Base.Orientation, 1) == 1:
            link.symlink_to(file)
            return
        upright = ImageOps.exif_transpose(image)
        upright.save(link, exif=upright.getexif(), quality=95)


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of photographs to match; `names` in the order of the sequence."""
    if len(names) <= ALL_PAIRS:
        return list(combinations(names, 2))
    gaps = {*range(1, FOLLOWING + 1)} | {2**k for k in range(4, len(names).bit_length())}
    near = {(i, i + gap) for i in range(len(names)) for gap in gaps if i + gap < len(names)}
    anchors = sorted({round(k * (len(names) - 1) / (ANCHORS - 1)) for k in range(ANCHORS)})
    return [(names[i], names[j]) for i, j in sorted(near | set(combinations(anchors, 2)))]


def _registered(model: pycolmap.Reconstruction | None) -> int:
    return 0 if model is None else model.num_reg_images()


def _best_model(
    work: Path, images: Path, lenses: dict[str, tuple], progress: Progress
) -> pycolmap.Reconstruction | None:
    """Return the largest model of the attempts, which end with the first that is large enough."""
    best = None
    for number, attempt in enumerate(ATTEMPTS):
        model = _reconstruct(work / str(number), images, lenses, attempt, progress)
        best = max(best, model, key=_registered)
        if _registered(best) >= ENOUGH * len(lenses):
            break
    return best


def _reconstruct(
    work: Path, images: Path, lenses: dict[str, tuple], attempt: Attempt, progress: Progress
) -> pycolmap.Reconstruction | None:
    """Return the largest model that can be built; images of the same lens have one camera."""
    work.mkdir()
    database = work / "database.db"
    task = progress.add_task("features", total=len(lenses))
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=attempt.max_side)
    extraction.sift.max_num_features = attempt.features
    extraction.sift.peak_threshold = attempt.contrast
    for lens in dict.fromkeys(lenses.values()):
        options = pycolmap.ImageReaderOptions()
        for chunk in _chunks([name for name in lenses if lenses[name] == lens], CHUNK):
            pycolmap.extract_features(
                database,
                images,
                image_names=chunk,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=options,
                extraction_options=extraction,
            )
            with pycolmap.Database.open(database) as stored:  # the group's, made with its first
                options.existing_camera_id = max(c.camera_id for c in stored.read_all_cameras())
            progress.advance(task, len(chunk))
    pairs = _pairs(list(lenses))
    task = progress.add_task("matches", total=len(pairs))
    matching = pycolmap.FeatureMatchingOptions(guided_matching=attempt.guided)
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=attempt.pair)
    verification.ransac.random_seed = SEED
    for chunk in _chunks(pairs, CHUNK**2):
        listed = work / "pairs.txt"
        listed.write_text("".join(f"{first} {second}\n" for first, second in chunk))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        pycolmap.match_image_pairs(database, matching, pairing, verification)
        progress.advance(task, len(chunk))
    task = progress.add_task("cameras", total=len(lenses))
    options = pycolmap.IncrementalPipelineOptions(
        min_num_matches=attempt.pair, min_model_size=LEAST_PHOTOGRAPHS, random_seed=SEED
    )
    options.mapper.init_min_num_inliers = attempt.first_pair
    options.mapper.init_min_tri_angle = attempt.angle
    options.mapper.abs_pose_min_num_inliers = attempt.image
    models = pycolmap.incremental_mapping(
        database, images, work, options, next_image_callback=lambda: progress.advance(task)
    )
    return max(models.values(), key=_registered, default=None)


@contextmanager
def _quiet_colmap() -> Iterator[None]:
    """Keep COLMAP from printing what it does."""
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, ONLY_FATAL
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _chunks(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def main(arguments: list[str] | None = None) -> int:
    parser = ArgumentParser(prog="python -m asysplat.data.cameras", description=__doc__)
    parser.add_argument("path", type=Path, help="a folder of photographs, or a video")
    parser.add_argument("--out", type=Path, default=Path("logs/cameras"), help="outside of it")
    parser.add_argument("--frames", type=int, default=100, help="of a video, at most")
    parser.add_argument("--on-bad-image", default="fail", choices=("fail", "skip"))
    options = parser.parse_args(arguments)
    try:
        refuse_inside(options.out, options.path, "name a folder elsewhere with --out")
        folder = find_cameras(
            options.path, options.out, options.frames, options.on_bad_image, Console()
        )
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
