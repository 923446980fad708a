"""Whether the cameras fit the images, and if not, which mistake explains it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from asysplat.data.check.epipolar import epipolar_distances, triangulate
from asysplat.data.check.matching import Matches
from asysplat.data.check.mistakes import Mistake, other_focal, other_resolution, usual_mistakes
from asysplat.scene import Cameras

LIMIT = 1.5  # pixels: cameras that fit are below it in the median
NEARLY = 5.0  # pixels: poses that are right but for their precision
NOISE = 0.5  # pixels: matches are no more precise, so that smaller errors are not compared
CLEARLY = 2.0  # times better: what makes one explanation beat another
ALIKE = 1.1  # times worse: of explanations as good as that the likelier counts
FEWEST = 100  # matches
TELLING = 1.0  # degrees between two rays; below it, noise decides on which side they meet
WIDEST = 10.0  # of the factors that are fitted
TRIALS = 41  # of factors, twice
FITTED = 3  # every such match is used for that


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
        """The error, unless the cameras see what lies behind them."""
        return self.error if self.behind < 0.5 else float("inf")


@dataclass(frozen=True)
class Verdict:
    """What the matches say of the cameras.

    Args:
        fits: whether the cameras as read fit the images.
        sentence: the same in words; where they do not fit, why, and what to do.
        read: how well the cameras as read fit; None without enough matches.
        mistake, undone: the other explanation that fits best, and how well.
    """

    fits: bool
    sentence: str
    read: Fit | None = None
    mistake: Mistake | None = None
    undone: Fit | None = None


def judge(cameras: Cameras, matches: Matches, names: Sequence[str]) -> Verdict:
    """Compare the cameras as read with every usual mistake undone.

    Args:
        cameras: of all frames.
        names: of their image files.
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
    """How well `cameras`, in float64, explain the matches."""
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
    """With the factor that leaves the least error, to about 0.3 %."""

    def error(factor: float) -> float:
        return float(epipolar_distances(make(factor).undo(cameras), matches).median())

    coarse = min(np.geomspace(1 / WIDEST, WIDEST, TRIALS).tolist(), key=error)
    step = WIDEST ** (2 / (TRIALS - 1))
    return make(min(np.geomspace(coarse / step, coarse * step, TRIALS).tolist(), key=error))


def _differ(one: Cameras, other: Cameras) -> bool:
    """fx and fy that are exchanged but equal are no mistake."""
    same_poses = torch.equal(one.cam_to_world, other.cam_to_world)
    return not (same_poses and torch.allclose(one.intrinsics, other.intrinsics, rtol=0.02))


def _explained(mistake: Mistake, undone: Fit) -> str:
    return f"{mistake.name} (undone, the error is {undone.error:.2f} px): {mistake.mend}"


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
