"""Diagnose the cameras of a scene, and collect all measurements in a report."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from asysplat.data.bad_images import BadImages
from asysplat.data.check.matches import Matches, epipolar_distances, find_matches, triangulate
from asysplat.data.check.mistakes import Mistake, common_mistakes, other_focal, other_resolution
from asysplat.data.images import content_hash
from asysplat.data.sequence import FileSequence, ImageSequence, PosedScene, SceneOptions
from asysplat.scene import Cameras

MAX_SIDE = 960  # pixels: longer side of the images in which points are matched
MAX_ERROR = 1.5  # pixels: median error of cameras that fit
ROUGH_ERROR = 5.0  # pixels: median error of cameras that only lack precision
MATCH_PRECISION = 0.5  # pixels; smaller errors are not compared
MIN_IMPROVEMENT = 2.0  # times less error after a correction, to blame its mistake
TIE = 1.1  # times the least error: the most likely mistake up to there is reported
MIN_MATCHES = 100
MIN_RAY_ANGLE = 1.0  # degrees; below it, noise decides on which side two rays meet
MAX_FACTOR = 10.0  # fitted factors lie between 1 / MAX_FACTOR and MAX_FACTOR
TRIALS = 41  # factors tried, coarsely and then finely
FIT_STRIDE = 3  # one match in so many is used to fit them
MAX_LENSES = 3  # printed, the most common ones
DEPTH_AGREEMENT = (0.8, 1.25)  # median of depth maps over triangulated depths without advice
# Of a match whose depth is compared: pixels, and degrees between its rays.
MAX_EPIPOLAR_ERROR, MIN_DEPTH_ANGLE = 1.0, 1.5

NO_MISTAKE_FOUND = (
    "the cameras do not fit the images, and no usual mistake explains it: check in check.png "
    "whether the path is the real one, and whether each pose has its own image"
)
ROUGH_FIT = (
    "the cameras fit the images only roughly, and no usual mistake explains it: refine "
    "them by bundle adjustment, and check for lens distortion or a rolling shutter"
)


@dataclass(frozen=True)
class Fit:
    """Agreement of cameras with matches."""

    error: float  # median distance to the epipolar lines, in pixels
    under_1px: float  # fraction of the matches with a distance below 1 pixel
    behind_camera: float  # fraction of the triangulated points behind a camera

    @property
    def penalty(self) -> float:
        """The error; infinite if most points lie behind the cameras."""
        return self.error if self.behind_camera < 0.5 else float("inf")


@dataclass(frozen=True)
class Verdict:
    """The diagnosis of a scene's cameras."""

    fits: bool  # whether the cameras as read fit the images
    summary: str  # the same in words; if they do not fit, the reason and what to do
    fit: Fit | None = None  # fit of the cameras as read; None with too few matches


def diagnose_cameras(cameras: Cameras, matches: Matches, names: Sequence[str]) -> Verdict:
    """Compare the cameras as read, of the image files `names`, with common mistakes corrected."""
    if len(matches) < MIN_MATCHES:
        return Verdict(
            False,
            f"only {len(matches)} points were matched between images, too few for a diagnosis: "
            "check that the images are sharp, in the order they were taken, and show one place",
        )
    cameras = cameras.to(torch.float64)
    fit = measure_fit(cameras, matches)
    tried = []
    sample = matches.select(slice(None, None, FIT_STRIDE))
    fitted = [_fit_factor(create, cameras, sample) for create in (other_resolution, other_focal)]
    for mistake in common_mistakes(names) + fitted:
        corrected = mistake.correct(cameras)
        same_poses = torch.equal(cameras.cam_to_world, corrected.cam_to_world)
        # Exchanging equal fx and fy changes nothing.
        if not (same_poses and torch.allclose(cameras.intrinsics, corrected.intrinsics, rtol=0.02)):
            tried.append((mistake, measure_fit(corrected, matches)))
    least = min(corrected.penalty for _, corrected in tried)
    mistake, corrected = next(pair for pair in tried if pair[1].penalty <= TIE * least)
    improved = fit.penalty > max(MIN_IMPROVEMENT * corrected.penalty, MATCH_PRECISION)
    if improved and corrected.penalty < MAX_ERROR:
        error = f"{corrected.error:.2f} px"
        message = f"{mistake.name} (corrected, the error is {error}): {mistake.fix}"
    elif fit.penalty < MAX_ERROR:
        return Verdict(True, "the cameras fit the images", fit)
    elif fit.error < MAX_ERROR:
        message = "the points that the images share lie behind the cameras: see check.png"
    else:
        message = ROUGH_FIT if fit.penalty < ROUGH_ERROR else NO_MISTAKE_FOUND
    return Verdict(False, message, fit)


def measure_fit(cameras: Cameras, matches: Matches) -> Fit:
    """Compute the epipolar error of cameras (float64), and how many points lie behind them."""
    distances = epipolar_distances(cameras, matches)
    depths, angles = triangulate(cameras, matches)
    precise = (angles > MIN_RAY_ANGLE) & (distances < MAX_ERROR)
    negative = (depths[precise] < 0).any(-1).double()
    return Fit(
        error=float(distances.median()),
        under_1px=float((distances < 1).double().mean()),
        behind_camera=float(negative.mean()) if len(negative) else 0.0,
    )


def _fit_factor(create: Callable[[float], Mistake], cameras: Cameras, matches: Matches) -> Mistake:
    """Create the mistake with the factor of least error, to about 0.3 %."""

    def error(factor: float) -> float:
        return float(epipolar_distances(create(factor).correct(cameras), matches).median())

    coarse = min(np.geomspace(1 / MAX_FACTOR, MAX_FACTOR, TRIALS).tolist(), key=error)
    step = MAX_FACTOR ** (2 / (TRIALS - 1))
    return create(min(np.geomspace(coarse / step, coarse * step, TRIALS).tolist(), key=error))


@dataclass(frozen=True)
class Report:
    """The check of a scene."""

    sequence: FileSequence  # the usable images, at the size at which they were matched
    rows: list[tuple[str, str]]  # the name and text of each printed measurement
    matches: Matches
    verdict: Verdict


def check_scene(scene: PosedScene, bad: BadImages, console: Console | None = None) -> Report:
    """Decode every image, match some, and diagnose the cameras; `bad` collects damaged images."""
    if not scene.images:
        bad.report(scene.name, 0)
    lens = scene.images[0].lens
    scale = min(1.0, MAX_SIDE / max(lens.height, lens.width))
    size = (round(lens.height * scale), round(lens.width * scale))
    sequence, known = read_pixels(FileSequence(scene, SceneOptions(*size)), bad, console)
    matches = find_matches(sequence, console)
    images, points = sequence.scene.images, sequence.points
    verdict = diagnose_cameras(sequence.cameras, matches, [str(image.file) for image in images])
    rows = [("images", str(len(images)))]
    stored = {(content_hash(image.file), image.lens.yaw) for image in images}
    if identical := len(images) - len(stored):
        rows.append(("", f"{identical} with the same file as another"))
    lenses = Counter(replace(image.lens, yaw=0.0) for image in images)
    for lens, count in lenses.most_common(MAX_LENSES):
        model = f" {lens.model}" if lens.is_distorted else ""
        numbers = f"fx {lens.fx:.5g}, fy {lens.fy:.5g}, cx {lens.cx:.5g}, cy {lens.cy:.5g}"
        rows.append(("lens", f"{count} of {lens.width} x {lens.height}{model}: {numbers}"))
    masks = f"{known['masks']:.1%} of the pixels are kept" if "masks" in known else "none"
    rows += [("points", "none" if points is None else str(len(points))), ("masks", masks)]
    rows += [("depth maps", _describe_depths(sequence, known, matches, verdict))]
    rows += [("left out", error) for error in bad.errors]
    rows += [("matches", f"{len(matches)} of {len(matches.pairs)} pairs of images")]
    if fit := verdict.fit:
        text = f"{fit.error:.2f} px in the median, {fit.under_1px:.0%} under 1 px"
        behind = f"; {fit.behind_camera:.0%} lie behind a camera"
        rows.append(("epipolar error", text + (behind if fit.behind_camera >= 0.01 else "")))
    return Report(sequence, rows, matches, verdict)


def read_pixels(
    sequence: FileSequence, bad: BadImages, console: Console | None
) -> tuple[FileSequence, dict[str, float]]:
    """Decode every image once; return the sequence of those that are not damaged.

    And the fraction of the pixels with a known depth under "depths", and of those that masks keep
    under "masks", where there are such files.
    """
    intact, fractions = [], {}
    images, hidden = sequence.scene.images, console is None
    bar = track(images, "decoding", console=console, transient=True, disable=hidden)
    for index, image in enumerate(bar):
        with bad.collect():
            views = sequence.views([index])
            intact.append(image)
            for name in ("depths", "masks"):
                if (values := getattr(views, name)) is not None:
                    fractions.setdefault(name, []).append(float((values > 0).double().mean()))
    bad.report(sequence.name, len(intact))
    means = {name: fmean(per_image) for name, per_image in fractions.items()}
    return sequence.with_images(intact), means


def compare_depths(sequence: ImageSequence, matches: Matches) -> tuple[float, int]:
    """Return the median of stored over precisely triangulated depths, and the number compared."""
    cameras = sequence.cameras.to(torch.float64)
    depths, angles = triangulate(cameras, matches)
    precise = (angles > MIN_DEPTH_ANGLE) & (depths > 0).all(-1)
    precise &= epipolar_distances(cameras, matches) < MAX_EPIPOLAR_ERROR
    indices, points, depths = (
        values[precise].flatten(0, 1) for values in (matches.indices, matches.points, depths)
    )
    ratios = [torch.empty(0, dtype=torch.float64)]
    for index in indices.unique().tolist():
        in_image = indices == index
        stored = sequence.views([index]).depths
        assert stored is not None
        column, row = points[in_image].long().unbind(-1)
        ratios.append(stored[0].double()[row, column] / depths[in_image])
    known = torch.cat(ratios)
    known = known[known > 0]
    return float(known.median()), len(known)


def _describe_depths(
    sequence: FileSequence, known: dict[str, float], matches: Matches, verdict: Verdict
) -> str:
    if "depths" not in known:
        return "none"
    text = f"known at {known['depths']:.1%} of the pixels"
    ratio, points = compare_depths(sequence, matches)
    if points:
        text += f"; {ratio:.3f} of the triangulated depths of {points} points"
        if verdict.fits and not DEPTH_AGREEMENT[0] < ratio < DEPTH_AGREEMENT[1]:
            text += f": divide the unit of depth by {ratio:.4g}"
    return text
