"""Find features of photographs and match them between pairs, in a database of COLMAP."""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TypeVar

import pycolmap
from rich.progress import Progress

ALL_PAIRS = 80  # greatest number of photographs of which all pairs are matched
FOLLOWING = 10  # next photographs that each is matched with, besides those 16, 32, ... further on
ANCHORS = 40  # evenly spread photographs that are all matched: a sequence may return to a place
PARTNERS = 8  # others that each photograph is matched with in a second attempt
AROUND = 40  # photographs before and after one without a camera that it is then matched with
CHUNK = 8  # photographs, or that squared of pairs, between two updates of the progress bar
SEED = 0
AnyLens = TypeVar("AnyLens", bound=Hashable)
Item = TypeVar("Item")


@dataclass(frozen=True)
class Effort:
    """How hard features and matches are sought."""

    max_side: int  # pixels of the longer side; larger images are shrunk to find features
    features: int  # greatest number in an image
    contrast: float  # least of a feature
    ratio: float  # greatest distance of a match, over that of the second best
    pair: int  # least number of inliers of a pair
    guided: bool = False  # whether matches are sought again along epipolar lines, which takes long


USUAL = Effort(1600, 4096, 0.0067, ratio=0.8, pair=15)
HARD = Effort(3200, 8192, 0.002, ratio=0.9, pair=10)
FURTHER = replace(USUAL, pair=10, guided=True)


def match_photographs(
    work: Path,
    lenses: Mapping[str, AnyLens],
    effort: Effort,
    progress: Progress,
    cameras: Mapping[AnyLens, pycolmap.Camera] | None = None,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> Path:
    """Write a database of features and verified matches of work/images; return its path.

    Args:
        work: its masks/ may have NAME.png, 0 where features are not wanted.
        lenses: by photograph, in the order of the sequence; those of the same lens have one camera.
        cameras: camera of each lens, where lenses are known; else a focal length is guessed.
        pairs: names of two to match; None: of all, or of those that are near in a long sequence.
    """
    database = work / f"{effort.features}.db"
    write_images(database, work, lenses, cameras)
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=effort.max_side)
    extraction.sift.max_num_features = effort.features
    extraction.sift.peak_threshold = effort.contrast
    task = progress.add_task("features", total=len(lenses))
    options = pycolmap.ImageReaderOptions()
    if (work / "masks").is_dir():
        options.mask_path = work / "masks"
    for chunk in _chunks(list(lenses), CHUNK):
        pycolmap.extract_features(
            database,
            work / "images",
            image_names=chunk,
            reader_options=options,
            extraction_options=extraction,
        )
        progress.advance(task, len(chunk))
    _match(database, usual_pairs(list(lenses)) if pairs is None else pairs, effort, progress)
    return database


def write_images(
    database: Path,
    work: Path,
    lenses: Mapping[str, AnyLens],
    cameras: Mapping[AnyLens, pycolmap.Camera] | None = None,
) -> None:
    """Write a database of images and their cameras, without features; see `match_photographs`."""
    pycolmap.Database.open(database).close()
    for lens in dict.fromkeys(lenses.values()):
        options = pycolmap.ImageReaderOptions()
        if cameras is not None:
            options.camera_model = cameras[lens].model_name
            options.camera_params = cameras[lens].params_to_string()
        # In order: otherwise threads number the images, and no two runs are alike.
        names = [name for name in lenses if lenses[name] == lens]
        single = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, work / "images", single, names, options)


def likely_pairs(database: Path, names: Sequence[str]) -> list[tuple[str, str]]:
    """List pairs of photographs: of each those with its PARTNERS that match it most.

    Matches count before they are verified; without any, photographs that follow each other do.
    """
    order = {name: number for number, name in enumerate(names)}
    matches = {}
    with pycolmap.Database.open(database) as stored:
        numbers = {image.image_id: order[image.name] for image in stored.read_all_images()}
        for pair, count in zip(*stored.read_num_matches(), strict=True):
            first, second = (numbers[image] for image in pycolmap.pair_id_to_image_pair(pair))
            matches[first, second] = matches[second, first] = count
    chosen = set()
    for one in range(len(names)):
        others = [other for other in range(len(names)) if other != one]
        others.sort(key=lambda x: (-matches.get((one, x), 0), abs(one - x)))
        chosen |= {(min(one, other), max(one, other)) for other in others[:PARTNERS]}
    return [(names[i], names[j]) for i, j in sorted(chosen)]


def match_further(
    database: Path, names: Sequence[str], without: Sequence[str], progress: Progress
) -> None:
    """Match photographs `without` a camera with more of the others.

    Of a sequence, they are matched along epipolar lines with those AROUND and with anchors; where
    all pairs were matched, once more with those that matched them most.
    """
    order = {name: number for number, name in enumerate(names)}
    pairs = set()
    for number in map(order.__getitem__, without):
        near = range(max(0, number - AROUND), min(len(names), number + AROUND + 1))
        others = {*near, *_anchors(len(names))} - {number}
        pairs |= {(min(number, other), max(number, other)) for other in others}
    pairs -= {(order[first], order[second]) for first, second in usual_pairs(names)}
    named = [(names[i], names[j]) for i, j in sorted(pairs)]
    if not named:
        named = [pair for pair in likely_pairs(database, names) if not {*without}.isdisjoint(pair)]
        with pycolmap.Database.open(database) as stored:
            numbers = {image.name: image.image_id for image in stored.read_all_images()}
            for first, second in named:  # else they would not be matched again
                stored.delete_matches(numbers[first], numbers[second])
                stored.delete_two_view_geometry(numbers[first], numbers[second])
    _match(database, named, FURTHER, progress)


def _match(
    database: Path, pairs: Sequence[tuple[str, str]], effort: Effort, progress: Progress
) -> None:
    task = progress.add_task("matches", total=len(pairs))
    matching = pycolmap.FeatureMatchingOptions(guided_matching=effort.guided)
    matching.sift.max_ratio = effort.ratio
    for chunk in _chunks(pairs, CHUNK**2):
        pairing = pycolmap.ImportedPairingOptions(match_list_path=_listed(database, chunk))
        pycolmap.match_image_pairs(database, matching, pairing, _verification(effort))
        progress.advance(task, len(chunk))


def verify_pairs(database: Path, pairs: Sequence[tuple[str, str]], effort: Effort) -> None:
    """Verify matches that are written already by the geometry of two views."""
    pycolmap.verify_matches(database, _listed(database, pairs), _verification(effort))


def _verification(effort: Effort) -> pycolmap.TwoViewGeometryOptions:
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=effort.pair)
    verification.ransac.random_seed = SEED
    return verification


def _listed(database: Path, pairs: Sequence[tuple[str, str]]) -> Path:
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    return listed


def usual_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """List all pairs of photographs, or of a long sequence those that are near, and anchors."""
    if len(names) <= ALL_PAIRS:
        return list(combinations(names, 2))
    gaps = {*range(1, FOLLOWING + 1)} | {2**k for k in range(4, len(names).bit_length())}
    near = {(i, i + gap) for i in range(len(names)) for gap in gaps if i + gap < len(names)}
    anchors = combinations(_anchors(len(names)), 2)
    return [(names[i], names[j]) for i, j in sorted(near | set(anchors))]


def _anchors(count: int) -> list[int]:
    return sorted({round(k * (count - 1) / (ANCHORS - 1)) for k in range(ANCHORS)})


def _chunks(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    return (items[start : start + size] for start in range(0, len(items), size))
