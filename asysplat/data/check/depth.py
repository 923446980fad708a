"""Whether depth maps have the scale of the poses."""

from dataclasses import dataclass

import torch

from asysplat.data.capture import Capture
from asysplat.data.check.epipolar import epipolar_distances, triangulate
from asysplat.data.check.matching import Matches
from asysplat.data.check.pixels import Quartiles, quartiles

PRECISE = 1.0  # pixels beside the epipolar line
WIDE = 1.5  # degrees between the rays


@dataclass(frozen=True)
class DepthScale:
    """Depth maps over triangulated depths: quartiles, and of how many points."""

    ratios: Quartiles
    points: int


def compare_depths(capture: Capture, matches: Matches) -> DepthScale | None:
    """At the matches that are triangulated precisely; None where no depth is known there."""
    cameras = capture.cameras.to(torch.float64)
    depths, angles = triangulate(cameras, matches)
    sure = (angles > WIDE) & (epipolar_distances(cameras, matches) < PRECISE) & (depths > 0).all(-1)
    ratios = [torch.empty(0, dtype=torch.float64)]
    frames, points, depths = (
        x[sure].flatten(0, 1) for x in (matches.frames, matches.points, depths)
    )
    for frame in frames.unique().tolist():
        here = frames == frame
        stored = capture.views([frame]).depths[0].double()
        column, row = points[here].long().unbind(-1)
        ratios.append(stored[row, column] / depths[here])
    ratios = torch.cat(ratios)
    known = ratios[ratios > 0]
    return DepthScale(quartiles(known), len(known)) if len(known) else None
