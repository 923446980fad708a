"""Everything that the check finds out of one scene."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from asysplat.data.bad_frames import BadFrames
from asysplat.data.check.depth import DepthScale, compare_depths
from asysplat.data.check.matching import Matches, find_matches
from asysplat.data.check.path import CameraPath, PointsSeen, count_points, measure_path
from asysplat.data.check.pixels import Pixels, read_pixels
from asysplat.data.check.verdict import Verdict, judge
from asysplat.data.images import Lens, content_hash
from asysplat.data.photographs import PhotographCapture, PosedScene

LONGEST = 960  # pixels of a side at which points are matched and distances are measured


@dataclass(frozen=True)
class Report:
    """What was found; lengths are in scene units.

    Args:
        capture: the frames that can be used, at the size at which they were compared.
        damaged: a sentence for each frame that cannot be used.
        lenses: every kind of lens, with how many photographs were taken by it.
        identical: photographs whose file is the same as an earlier one's.
        depth_scale: None without depth maps, or where they show none of the matches.
        points: None without sparse points.
        matches: by which the cameras are judged.
    """

    capture: PhotographCapture
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
    scene: PosedScene, bad: BadFrames, step: Callable[[str], None] = lambda stage: None
) -> Report:
    """Decode every frame, match some of them, and judge the cameras.

    Args:
        scene: as a reader gives it.
        bad: what that reader noted; damaged frames are added.
        step: called with "decode" or "match" whenever one of those is done.

    Raises:
        InputError: too few frames can be used, or some cannot and must not be skipped.
    """
    capture = PhotographCapture(scene, *_size(scene, bad))
    capture, pixels = read_pixels(capture, bad, partial(step, "decode"))
    photographs, cameras = capture.scene.photographs, capture.cameras
    matches = find_matches(capture, partial(step, "match"))
    points = capture.scene.points
    files = {content_hash(photograph.image) for photograph in photographs}
    has_depths = pixels.depth_known is not None
    return Report(
        capture=capture,
        damaged=list(bad.sentences),
        lenses=Counter(photograph.lens for photograph in photographs).most_common(),
        identical=len(photographs) - len(files),
        pixels=pixels,
        path=measure_path(cameras),
        points=None if points is None else count_points(cameras, torch.tensor(points).double()),
        matches=matches,
        depth_scale=compare_depths(capture, matches) if has_depths else None,
        verdict=judge(cameras, matches, [str(photograph.image) for photograph in photographs]),
    )


def _size(scene: PosedScene, bad: BadFrames) -> tuple[int, int]:
    """Height and width with the first photograph's proportions, no larger than needed."""
    if not scene.photographs:
        bad.settle(scene.name, 0)
    lens = scene.photographs[0].lens
    scale = min(1.0, LONGEST / max(lens.height, lens.width))
    return round(lens.height * scale), round(lens.width * scale)
