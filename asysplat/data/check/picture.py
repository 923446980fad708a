"""A report as a picture: the camera path, and epipolar lines on pairs of images."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from asysplat.data.check.epipolar import epipolar_lines
from asysplat.data.check.report import Report
from asysplat.scene import Cameras

WIDTH, PATH, TALLEST, TITLE = 12.0, 5.0, 4.5, 0.3  # inches: in all, and down the page
PAIRS = 3
LINES = 10  # a pair
ARROWS = 60  # along the path
POINTS = 5000  # of the sparse points
NEAR = (0.05, 0.95)  # quantiles of the sparse points that the picture has room for
MARGIN = 0.1  # around the path and the points, of their size

Item = TypeVar("Item")


def draw_report(report: Report, title: str) -> Figure:
    """The path from above and from the side. Below, the frames of a few pairs, one above the other:
    matched points, and the lines on which the cameras put each from its place in the other frame.
    """
    cameras = report.capture.cameras
    tall = min(WIDTH / PAIRS * cameras.height / cameras.width, TALLEST) + TITLE
    figure = Figure(figsize=(WIDTH, PATH + 2 * tall), layout="constrained")
    figure.suptitle(f"{title}: {report.verdict.sentence}", wrap=True)
    paths, images = figure.subfigures(2, 1, height_ratios=(PATH, 2 * tall))
    _draw_path(report, *paths.subplots(1, 2))
    pairs = _spread(report.matches.pairs, PAIRS)
    if pairs:
        for plots, pair in zip(
            images.subplots(2, len(pairs), squeeze=False).T.tolist(), pairs, strict=True
        ):
            _draw_pair(report, pair, plots)
    return figure


def _draw_path(report: Report, above: Axes, side: Axes) -> None:
    cameras, points = report.capture.cameras, report.capture.scene.points
    axes = _upright(cameras)
    centers = cameras.centers.double().numpy() @ axes
    ahead = cameras.cam_to_world[:, :3, 2].double().numpy() @ axes
    sparse = np.empty((0, 3)) if points is None else points @ axes
    drawn = sparse[:: max(1, len(sparse) // POINTS)]
    arrows = _spread(range(len(centers)), ARROWS)
    for plot, x, y, where in ((above, 0, 1, "above"), (side, 1, 2, "the side")):
        plot.set_title(f"path from {where}, dark to light; scene units")
        plot.scatter(drawn[:, x], drawn[:, y], s=1, c="0.7", linewidths=0)
        plot.plot(centers[:, x], centers[:, y], c="0.4", lw=0.8)
        plot.quiver(
            *(centers[arrows, x], centers[arrows, y], ahead[arrows, x], ahead[arrows, y], arrows),
            **{"cmap": "viridis", "angles": "xy", "scale": 16, "width": 0.004},
        )
        plot.set_aspect("equal")
        plot.set_xlim(*_room(centers[:, x], sparse[:, x]))
        plot.set_ylim(*_room(centers[:, y], sparse[:, y]))


def _draw_pair(report: Report, pair: tuple[int, int], plots: Sequence[Axes]) -> None:
    capture = report.capture
    height, width = capture.cameras.height, capture.cameras.width
    matches = report.matches.of(pair)
    matches = matches.select(
        torch.tensor(_spread(matches.points[:, 0, 0].argsort().tolist(), LINES))
    )
    lines = epipolar_lines(capture.cameras.to(torch.float64), matches)
    images = capture.views(pair).images.permute(0, 2, 3, 1).numpy()
    for view, plot in enumerate(plots):
        # The first pixel's centre is at +0.5.
        plot.imshow(images[view], extent=(0, width, height, 0))
        plot.set_title(f"frame {pair[view]}")
        plot.set_axis_off()
        for number in range(len(matches)):
            a, b, c = lines[number, view].tolist()
            x, y = matches.points[number, view].tolist()
            colour = f"C{number}"
            if np.isfinite(c):
                distance = a * x + b * y + c
                foot = (x - distance * a, y - distance * b)
                plot.axline(foot, (foot[0] - b, foot[1] + a), color=colour, lw=0.8)
            plot.plot(x, y, "o", color=colour, ms=5, mec="white", mew=0.7)
        plot.set_xlim(0, width)
        plot.set_ylim(height, 0)


def _upright(cameras: Cameras) -> Float[ndarray, "3 3"]:
    """Columns: right, ahead and up in the world. Up is where the cameras' tops point in the mean,
    right what is right for the first of them."""
    rotations = cameras.cam_to_world[:, :3, :3].double().numpy()
    up, right = -rotations[:, :, 1].mean(0), rotations[0, :, 0]
    ahead = np.cross(up, right)
    axes = (np.cross(ahead, up), ahead, up)
    return np.stack([axis / max(np.linalg.norm(axis), 1e-9) for axis in axes], 1)


def _room(centers: Float[ndarray, " N"], points: Float[ndarray, " P"]) -> tuple[float, float]:
    """Of all cameras and most points."""
    ends = [*centers, *(np.quantile(points, NEAR) if len(points) else ())]
    margin = MARGIN * max(max(ends) - min(ends), 1e-6)
    return min(ends) - margin, max(ends) + margin


def _spread(items: Sequence[Item], count: int) -> list[Item]:
    """At most `count` of them, evenly."""
    places = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(place)] for place in places]
