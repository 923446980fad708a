"""What is concluded of a scene: all that was measured, whether the cameras fit, and if not, why."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from asysplat.data.bad_images import BadFrames
from asysplat.data.sequence import FileSequence, PosedScene
from asysplat.data.check.matches import Matches, epipolar_distances, find_matches, triangulate
from asysplat.data.check.measurements import (
    CameraPath,
    DepthScale,
    Pixels,
    PointsSeen,
    compare_depths,
    count_points,
    measure_path,
    read_pixels,
)
from asysplat.data.check.mistakes import Mistake, other_focal, other_resolution, usual_mistakes
from asysplat.data.images import Lens, content_hash
from asysplat.scene import Cameras

LONGEST = 960  # pixels: longer side, at most, of the images in which points are matched
LIMIT = 1.5  # pixels: cameras that fit are below it in the median
NEARLY = 5.0  # pixels: poses that are right but for their precision
NOISE = 0.5  # pixels: precision of the matches; smaller errors are not compared
CLEARLY = 2.0  # times smaller error: with a mistake undone, to blame that mistake
ALIKE = 1.1  # times the least error: the likeliest mistake with at most that counts
FEWEST = 100  # matches, to judge by
TELLING = 1.0  # degrees between two rays; below it, noise decides on which side they meet
WIDEST = 10.0  # fitted factors lie between 1 / WIDEST and WIDEST
TRIALS = 41  # factors tried, coarsely and then finely
FITTED = 3  # one match in so many is used to fit them


@dataclass(frozen=True)
class Fit:
    """How well cameras explain matches.

    Args:
        error: median distance to the epipolar lines, in pixels.
        under_1px: share of the matches that are nearer than that.
        behind: share of the triangulated points that lie behind a camera.
    """

    error: float
    under_1px: float
    behind: float

    @property
    def badness(self) -> float:
        """The error; infinite if most points lie behind the cameras."""
        return self.error if self.behind < 0.5 else float("inf")


@dataclass(frozen=True)
class Verdict:
    """What the matches say of the cameras.

    Args:
        fits: whether the cameras as read fit the images.
        sentence: the same in words; where they do not fit, why, and what to do.
        read: how well the cameras as read fit; None without enough matches.
        mistake, undone: the mistake that explains the matches best, and how well the cameras fit
            with it undone.
    """

    fits: bool
    sentence: str
    read: Fit | None = None
    mistake: Mistake | None = None
    undone: Fit | None = None


def judge(cameras: Cameras, matches: Matches, names: Sequence[str]) -> Verdict:
    """Compare the cameras as read with every usual mistake undone.

    Args:
        cameras: one a frame, in order.
        names: the frames' image files.
    """
    if len(matches) < FEWEST:
        return Verdict(
            False,
            f"only {len(matches)} points were found again in other frames, too few to tell: look "
            "whether the images are sharp, in the order they were taken, and show one place",
        )
    cameras = cameras.to(torch.float64)
    read = measure_fit(cameras, matches)
    tried = []
    for mistake in usual_mistakes(names) + _fitted_mistakes(cameras, matches):
        undone = mistake.undo(cameras)
        if _differ(cameras, undone):
            tried.append((mistake, measure_fit(undone, matches)))
    least = min(fit.badness for _, fit in tried)
    mistake, undone = next((m, fit) for m, fit in tried if fit.badness <= ALIKE * least)
    if read.badness > max(CLEARLY * undone.badness, NOISE) and undone.badness < LIMIT:
        return Verdict(False, _explained(mistake, undone), read, mistake, undone)
    if read.badness >= LIMIT:
        return Verdict(False, _unexplained(read), read, mistake, undone)
    return Verdict(True, "the cameras fit the images", read, mistake, undone)


def measure_fit(cameras: Cameras, matches: Matches) -> Fit:
    """Measure how well cameras (float64) explain the matches."""
    distances = epipolar_distances(cameras, matches)
    depths, angles = triangulate(cameras, matches)
    telling = (angles > TELLING) & (distances < LIMIT)
    behind = (depths[telling] < 0).any(-1).double()
    return Fit(
        error=float(distances.median()),
        under_1px=float((distances < 1).double().mean()),
        behind=float(behind.mean()) if len(behind) else 0.0,
    )


def _fitted_mistakes(cameras: Cameras, matches: Matches) -> list[Mistake]:
    few = matches.select(slice(None, None, FITTED))
    return [_fitted(make, cameras, few) for make in (other_resolution, other_focal)]


def _fitted(make: Callable[[float], Mistake], cameras: Cameras, matches: Matches) -> Mistake:
    """Make the mistake with the factor that leaves the least error, to about 0.3 %."""

    def error(factor: float) -> float:
        return float(epipolar_distances(make(factor).undo(cameras), matches).median())

    coarse = min(np.geomspace(1 / WIDEST, WIDEST, TRIALS).tolist(), key=error)
    step = WIDEST ** (2 / (TRIALS - 1))
    return make(min(np.geomspace(coarse / step, coarse * step, TRIALS).tolist(), key=error))


def _differ(one: Cameras, other: Cameras) -> bool:
    """Tell whether undoing a mistake changed anything; exchanging equal fx and fy does not."""
    same_poses = torch.equal(one.cam_to_world, other.cam_to_world)
    return not (same_poses and torch.allclose(one.intrinsics, other.intrinsics, rtol=0.02))


def _explained(mistake: Mistake, undone: Fit) -> str:
    return f"{mistake.name} (undone, the error is {undone.error:.2f} px): {mistake.fix}"


def _unexplained(read: Fit) -> str:
    if read.error < LIMIT:
        return "the points that the images share lie behind the cameras: look at check.png"
    if read.badness < NEARLY:
        return (
            "the cameras fit the images only roughly, and no usual mistake explains it: refine "
            "them by bundle adjustment, and look for lens distortion or a rolling shutter"
        )
    return (
        "the cameras do not fit the images, and no usual mistake explains it: look in check.png "
        "whether the path is the one that was walked, and whether each pose has its own image"
    )


@dataclass(frozen=True)
class Report:
    """All that was found out about a scene; lengths are in scene units.

    Args:
        sequence: the frames that can be used, at the size at which they were compared.
        damaged: a sentence for each frame that cannot be used.
        lenses: every kind of lens and the number of photographs that it took.
        identical: number of photographs whose file equals an earlier one.
        depth_scale: None without depth maps, or where they show none of the matches.
        points: None without sparse points.
        matches: the points by which the cameras are judged.
    """

    sequence: FileSequence
    damaged: list[str]
    lenses: list[tuple[Lens, int]]
    identical: int
    pixels: Pixels
    path: CameraPath
    points: PointsSeen | None
    matches: Matches
    depth_scale: DepthScale | None
    verdict: Verdict


def check_scene(
    scene: PosedScene, bad: BadFrames, step: Callable[[str], None] = lambda name: None
) -> Report:
    """Decode every frame, match some of them, and judge the cameras.

    Args:
        scene: what a reader returned.
        bad: the frames that the reader noted; damaged ones are added.
        step: called with "decode" or "match" whenever one of those is done.

    Raises:
        InputError: too few frames can be used, or some cannot and must not be skipped.
    """
    sequence = FileSequence(scene, *_size(scene, bad))
    sequence, pixels = read_pixels(sequence, bad, partial(step, "decode"))
    photographs, cameras = sequence.scene.photographs, sequence.cameras
    matches = find_matches(sequence, partial(step, "match"))
    points = sequence.scene.points
    files = {content_hash(photograph.image) for photograph in photographs}
    has_depths = pixels.depth_known is not None
    return Report(
        sequence=sequence,
        damaged=list(bad.sentences),
        lenses=Counter(photograph.lens for photograph in photographs).most_common(),
        identical=len(photographs) - len(files),
        pixels=pixels,
        path=measure_path(cameras),
        points=None if points is None else count_points(cameras, torch.tensor(points).double()),
        matches=matches,
        depth_scale=compare_depths(sequence, matches) if has_depths else None,
        verdict=judge(cameras, matches, [str(photograph.image) for photograph in photographs]),
    )


def _size(scene: PosedScene, bad: BadFrames) -> tuple[int, int]:
    """Return height and width: the first photograph's, or LONGEST with its proportions."""
    if not scene.photographs:
        bad.settle(scene.name, 0)
    lens = scene.photographs[0].lens
    scale = min(1.0, LONGEST / max(lens.height, lens.width))
    return round(lens.height * scale), round(lens.width * scale)
