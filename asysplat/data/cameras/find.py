"""Find the cameras of photographs or of a video: structure from motion.

With COLMAP (Schönberger & Frahm 2016, Structure-from-Motion Revisited), by pycolmap. Nothing is
written beside the photographs: the cameras go to a folder of their own in COLMAP's layout, with
links to the photographs, and the next call with the same photographs returns it at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap
from PIL import Image
from PIL.ExifTags import IFD, Base
from rich.console import Console
from rich.progress import Progress

from asysplat.data.bad_images import BadImages, Policy
from asysplat.data.cameras.features import (
    ALL_PAIRS,
    HARD,
    SEED,
    USUAL,
    Effort,
    likely_pairs,
    match_further,
    match_photographs,
    usual_pairs,
)
from asysplat.data.cameras.folder import (
    colmap_names,
    digest,
    keep,
    link_photograph,
    save_mask,
    work_folder,
)
from asysplat.data.cameras.learned import LEARNED_EFFORT, has_learned_features, match_learned
from asysplat.data.frames import SUFFIXES, save_sharp_frames
from asysplat.data.images import image_size
from asysplat.data.readers import open_scene, photographs_in
from asysplat.data.readers.additions import find_mask
from asysplat.data.sequence import SceneOptions
from asysplat.errors import InputError

MIN_FOUND = 0.25  # fraction of the photographs; with fewer there is no scene
ENOUGH = 0.9  # fraction of the photographs; with fewer the next attempt is made
LEAST_PHOTOGRAPHS = 3
LISTED = 10  # most photographs without a camera of which one is told why


@dataclass(frozen=True)
class Attempt:
    """How hard cameras are sought."""

    effort: Effort
    first_pair: int  # least number of inliers of the pair to start with
    image: int  # and of an image that is added
    angle: float  # least angle between the rays of the pair to start with, in degrees


ATTEMPTS = (Attempt(USUAL, 100, 30, 16.0), Attempt(HARD, 50, 15, 4.0))
LEARNED = Attempt(LEARNED_EFFORT, 50, 15, 4.0)


def find_cameras(
    photographs: Path | str,
    where: Path | str,
    frames: int = 100,
    on_error: Policy = "fail",
    console: Console | None = None,
) -> Path:
    """Find the cameras of photographs or of a video; return a folder in COLMAP's layout.

    Its images/ are links to the photographs, upright copies of those that are stored turned, or the
    frames of a video; its masks/ are theirs, and what they leave out is not matched; its sparse/0
    has the cameras and points. Where fewer than 9 of 10 cameras are found, the photographs of a
    sequence that are left are matched with more of the others; if there still are, a second attempt
    with weaker features of the pairs that matched most follows, and at its end one along epipolar
    lines for those that are left, and where it is installed a third with learned features; the
    best is returned.

    Args:
        photographs: folder of photographs of one place, or of an images/ with them; a scene whose
            given cameras are ignored; or a video.
    """
    source, where = Path(photographs).absolute(), Path(where).absolute()
    if not isinstance(frames, int) or frames < LEAST_PHOTOGRAPHS:
        raise InputError(f"frames={frames}: give a whole number of at least {LEAST_PHOTOGRAPHS}.")
    video = source.is_file() and source.suffix.lower() in SUFFIXES
    files = [source] if video else _photographs(source, on_error)
    lenses = {} if video else _lenses(files, source, on_error)
    masks = {file: mask for file in lenses if (mask := find_mask(file)) is not None}
    separate_masks = [mask for file, mask in masks.items() if mask != file]
    attempts = (*ATTEMPTS, LEARNED) if has_learned_features() else ATTEMPTS
    folder = where / f"{source.stem}-{digest(f'{attempts} {frames}', [*files, *separate_masks])}"
    if folder.is_dir():
        return folder
    with work_folder(where, frames if video else len(files), console) as (work, progress):
        images = work / "images"
        if video:
            save_sharp_frames(source, images, frames, progress)
            lenses = _lenses(photographs_in(images), source, on_error)
        names = colmap_names(lenses)
        for file, name in names.items():
            if not video:
                link_photograph(file, images / name, upright=True)
            mask = masks.get(file)
            save_mask(images / name if mask == file else mask, images / name)
        kinds = {names[file]: lens for file, lens in lenses.items()}
        model = database = None
        order = list(kinds)
        for attempt in attempts:
            pairs = usual_pairs(order) if database is None else likely_pairs(database, order)
            match = match_learned if attempt is LEARNED else match_photographs
            database = match(work, kinds, attempt.effort, progress, pairs=pairs)
            grown = _reconstruct(work, kinds, database, attempt, progress)
            model = max(model, grown, key=_registered)
            if _registered(model) >= ENOUGH * len(kinds):
                break
        if model is None or _registered(model) < max(LEAST_PHOTOGRAPHS, MIN_FOUND * len(kinds)):
            otherwise = "" if LEARNED in attempts else ", or pip install 'asysplat[matching]'"
            raise InputError(
                f"{photographs}: found cameras for {_registered(model)} of {len(kinds)} "
                "photographs: too few show the same place; photograph it with more overlap"
                f"{otherwise}."
            )
        assert database is not None  # there are attempts
        if console is not None and (why := _why_left(database, model, order)):
            console.print(f"no camera: {why}", highlight=False, markup=False)
        keep(work, model, folder)
    return folder


def _photographs(source: Path, on_error: Policy) -> list[Path]:
    """List the photographs of a folder, or of a scene that has them elsewhere."""
    if files := photographs_in(source):
        return files
    images = open_scene(source, SceneOptions(1, 1, on_error=on_error)).scene.images
    stored = dict.fromkeys(image.file for image in images)
    files = [file for file in stored if isinstance(file, Path)]
    if len(files) < len(stored):
        raise InputError(f"{source} has its images inside other files: cameras=given uses it.")
    return files


def _lenses(files: Sequence[Path], source: Path, on_error: Policy) -> dict[Path, tuple]:
    """Read what tells the camera of each photograph from others, see `_read_lens`."""
    if len(files) < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"{source} has {len(files)} photographs without camera poses: cameras are found from "
            f"at least {LEAST_PHOTOGRAPHS} that overlap."
        )
    bad = BadImages(on_error)
    lenses = dict(bad.read_each(lambda file: (file, _read_lens(file)), ((file,) for file in files)))
    bad.report(str(source), len(lenses))
    return lenses


def _read_lens(file: Path) -> tuple:
    """Read the size upright, and the make, model and focal length that the file names."""
    size = image_size(file)
    with Image.open(file) as image:
        exif = image.getexif()
        details = exif.get_ifd(IFD.Exif)
    turned = exif.get(Base.Orientation, 1) >= 5
    focal = details.get(Base.FocalLength), details.get(Base.FocalLengthIn35mmFilm)
    return (size[::-1] if turned else size, exif.get(Base.Make), exif.get(Base.Model), *focal)


def _registered(model: pycolmap.Reconstruction | None) -> int:
    return 0 if model is None else model.num_reg_images()


def _why_left(database: Path, model: pycolmap.Reconstruction, names: Sequence[str]) -> str:
    """List the photographs without a camera, and how many features and matches each has."""
    found = {image.name for image in model.images.values() if image.has_pose}
    left = [name for name in names if name not in found]
    most = dict.fromkeys(left, 0)
    with pycolmap.Database.open(database) as stored:
        images = {image.image_id: image.name for image in stored.read_all_images()}
        numbers = {name: number for number, name in images.items()}
        features = {name: stored.num_keypoints_for_image(numbers[name]) for name in left}
        for pair, count in zip(*stored.read_two_view_geometry_num_inliers(), strict=True):
            for name in map(images.get, pycolmap.pair_id_to_image_pair(pair)):
                if name in most:
                    most[name] = max(most[name], count)
    listed = [
        f"{name} ({features[name]:,} features, at most {most[name]} shared with another)"
        for name in left[:LISTED]
    ]
    return ", ".join(listed + [f"and {len(left) - LISTED} more"] * (len(left) > LISTED))


def _reconstruct(
    work: Path,
    lenses: dict[str, tuple],
    database: Path,
    attempt: Attempt,
    progress: Progress,
) -> pycolmap.Reconstruction | None:
    """Return the largest model that can be built; images of the same lens have one camera.

    Of a sequence, or in the last attempt, those that it left open are matched further, and it goes
    on with them.
    """
    model = _map(work, lenses, database, attempt, progress)
    if model is None or _registered(model) >= ENOUGH * len(lenses) or attempt is LEARNED:
        return model
    if len(lenses) <= ALL_PAIRS and attempt is not ATTEMPTS[-1]:
        return model  # weaker features of all are found sooner, and their cameras are more exact
    found = {image.name for image in model.images.values() if image.has_pose}
    without = [name for name in lenses if name not in found]
    match_further(database, list(lenses), without, progress)
    further = _map(work, lenses, database, ATTEMPTS[-1], progress, model)
    return max(model, further, key=_registered)


def _map(
    work: Path,
    lenses: dict[str, tuple],
    database: Path,
    attempt: Attempt,
    progress: Progress,
    start: pycolmap.Reconstruction | None = None,
) -> pycolmap.Reconstruction | None:
    """Return the largest model of verified matches, from two photographs or a model on."""
    task = progress.add_task("cameras", total=len(lenses), completed=_registered(start))
    begun = work / "begun"
    if start is not None:
        begun.mkdir(exist_ok=True)
        start.write(begun)
    options = pycolmap.IncrementalPipelineOptions(
        min_num_matches=attempt.effort.pair, min_model_size=LEAST_PHOTOGRAPHS, random_seed=SEED
    )
    if attempt is LEARNED:  # matches are so few that the order of threads would decide
        options.num_threads = 1
    options.mapper.init_min_num_inliers = attempt.first_pair
    options.mapper.init_min_tri_angle = attempt.angle
    options.mapper.abs_pose_min_num_inliers = attempt.image
    models = pycolmap.incremental_mapping(
        database,
        work / "images",
        work,
        options,
        input_path=begun if start is not None else "",
        next_image_callback=lambda: progress.advance(task),
    )
    return max(models.values(), key=_registered, default=None)
