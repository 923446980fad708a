"""Show a report on one screen, and as a picture."""

from collections.abc import Iterator, Sequence
from math import atan, degrees, isfinite
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.data.check.matches import epipolar_lines
from asysplat.data.check.report import Fit, Report
from asysplat.data.images import Lens
from asysplat.scene import Cameras

# The screen.
MOST_LENSES = 3  # printed one by one; of more, the number
MOST_DAMAGED = 10  # printed one by one
AGREES = (0.8, 1.25)  # median of depth maps over triangulated depths without a complaint

# The picture.
WIDTH, PATH, TALLEST, TITLE = 12.0, 5.0, 4.5, 0.3  # inches: in all, and down the page
PAIRS = 3  # of frames, at most
LINES = 10  # in a pair
ARROWS = 60  # along the path
POINTS = 5000  # sparse points, about
NEAR = (0.05, 0.95)  # quantiles of the sparse points that the picture has room for
MARGIN = 0.1  # around the path and the points, of their size

Item = TypeVar("Item")


def print_report(report: Report, title: str, console: Console) -> None:
    """Print what was read, line by line, and the verdict last, where it is seen."""
    table = Table(title=Text(title, "bold"), title_justify="left", box=None, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in _lines(report):
        table.add_row(name, Text(text))
    console.print(table)
    style = "bold green" if report.verdict.fits else "bold red"
    sentence = report.verdict.sentence
    console.print(Text(f"{sentence[0].upper()}{sentence[1:]}.", style))


def _lines(report: Report) -> Iterator[tuple[str, str]]:
    sequence, pixels, path = report.sequence, report.pixels, report.path
    same = f", {report.identical} with the same file as another" if report.identical else ""
    yield "frames", f"{sequence.num_frames}{same}"
    for lens, count in report.lenses[:MOST_LENSES]:
        yield "images", f"{count} of {_lens(lens)}"
    if len(report.lenses) > MOST_LENSES:
        yield "", f"and {len(report.lenses) - MOST_LENSES} other lenses"
    yield "brightness", "{:.2f} to {:.2f}, means of images in [0, 1]".format(*pixels.brightness)
    yield "path", f"{path.length:.4g} long, {path.extent:.4g} wide"
    yield (
        "a frame",
        (
            f"{path.step:.3g} in the median, {path.longest_step:.3g} at most; "
            f"{path.turn:.2g}° in the median, {path.widest_turn:.3g}° at most"
        ),
    )
    if path.repeated:
        yield "", f"{path.repeated} frames with the pose of an earlier frame"
    yield "points", _points(report)
    yield "depth maps", _depths(report)
    counted = "none" if pixels.counted is None else f"{pixels.counted:.1%} of the pixels count"
    yield "masks", counted
    for sentence in report.damaged[:MOST_DAMAGED]:
        yield "left out", sentence
    if len(report.damaged) > MOST_DAMAGED:
        yield "", f"and {len(report.damaged) - MOST_DAMAGED} more"
    yield from _fits(report)


def _lens(lens: Lens) -> str:
    across, down = (
        degrees(atan(center / focal) + atan((size - center) / focal))
        for center, focal, size in (
            (lens.cx, lens.fx, lens.width),
            (lens.cy, lens.fy, lens.height),
        )
    )
    kind = " fisheye" if lens.fisheye else " distorted" if lens.is_distorted else ""
    return (
        f"{lens.width} x {lens.height}{kind}, {across:.1f}° x {down:.1f}°: fx {lens.fx:.5g}, "
        f"fy {lens.fy:.5g}, cx {lens.cx:.5g}, cy {lens.cy:.5g}"
    )


def _points(report: Report) -> str:
    points = report.points
    if points is None:
        return "none"
    return (
        f"{points.count}, {points.seen:.1%} in front of and inside two views or more; "
        f"{points.views:g} views a point"
    )


def _depths(report: Report) -> str:
    pixels, scale = report.pixels, report.depth_scale
    if pixels.depth_known is None:
        return "none"
    text = f"known at {pixels.depth_known:.1%} of the pixels"
    if pixels.depths is not None:
        text += ", quartiles {:.4g} {:.4g} {:.4g}".format(*pixels.depths)
    if scale is None:
        return text
    text += "; over triangulated depths {:.3f} {:.3f} {:.3f}".format(*scale.ratios)
    text += f" ({scale.points} points)"
    if report.verdict.fits and not AGREES[0] < scale.ratios[1] < AGREES[1]:
        text += f": divide the unit of depth by {scale.ratios[1]:.4g}"
    return text


def _fits(report: Report) -> Iterator[tuple[str, str]]:
    verdict, matches, cameras = report.verdict, report.matches, report.sequence.cameras
    pairs = matches.pairs
    if not pairs:
        yield "matches", "none"
        return
    gaps = sorted(abs(first - second) for first, second in pairs)
    yield (
        "matches",
        (
            f"{len(matches)} of {len(pairs)} pairs, {gaps[0]} to {gaps[-1]} frames apart, at "
            f"{cameras.width} x {cameras.height}"
        ),
    )
    if verdict.read is not None:
        yield "epipolar error", _fit(verdict.read)
    if verdict.undone is not None and isfinite(verdict.undone.badness):
        name = "next best" if verdict.fits else "nearest"
        yield name, f"{verdict.undone.error:.2f} px, if {verdict.mistake.name}"


def _fit(fit: Fit) -> str:
    text = f"{fit.error:.2f} px in the median, {fit.under_1px:.0%} under 1 px"
    return text + (f"; {fit.behind:.0%} lie behind a camera" if fit.behind >= 0.01 else "")


def draw_report(report: Report, title: str) -> Figure:
    """Draw the path from above and from the side, and a few pairs of frames below.

    A pair's frames are one above the other, with matched points and their epipolar lines: where
    the cameras put each point, given its place in the other frame.
    """
    cameras = report.sequence.cameras
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
    cameras, points = report.sequence.cameras, report.sequence.scene.points
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
    sequence = report.sequence
    height, width = sequence.cameras.height, sequence.cameras.width
    matches = report.matches.of(pair)
    matches = matches.select(
        torch.tensor(_spread(matches.points[:, 0, 0].argsort().tolist(), LINES))
    )
    lines = epipolar_lines(sequence.cameras.to(torch.float64), matches)
    images = sequence.views(pair).images.permute(0, 2, 3, 1).numpy()
    for view, plot in enumerate(plots):
        # The first pixel's center is at +0.5.
        plot.imshow(images[view], extent=(0, width, height, 0))
        plot.set_title(f"frame {pair[view]}")
        plot.set_axis_off()
        for number in range(len(matches)):
            a, b, c = lines[number, view].tolist()
            x, y = matches.points[number, view].tolist()
            color = f"C{number}"
            if np.isfinite(c):
                distance = a * x + b * y + c
                foot = (x - distance * a, y - distance * b)
                plot.axline(foot, (foot[0] - b, foot[1] + a), color=color, lw=0.8)
            plot.plot(x, y, "o", color=color, ms=5, mec="white", mew=0.7)
        plot.set_xlim(0, width)
        plot.set_ylim(height, 0)


def _upright(cameras: Cameras) -> Float[ndarray, "3 3"]:
    """Return right, ahead and up in the world as columns.

    Up is the mean direction of the cameras' tops, right the first camera's right.
    """
    rotations = cameras.cam_to_world[:, :3, :3].double().numpy()
    up, right = -rotations[:, :, 1].mean(0), rotations[0, :, 0]
    ahead = np.cross(up, right)
    axes = (np.cross(ahead, up), ahead, up)
    return np.stack([axis / max(np.linalg.norm(axis), 1e-9) for axis in axes], 1)


def _room(centers: Float[ndarray, " N"], points: Float[ndarray, " P"]) -> tuple[float, float]:
    """Return the ends of an axis that shows all cameras and most points."""
    ends = [*centers, *(np.quantile(points, NEAR) if len(points) else ())]
    margin = MARGIN * max(max(ends) - min(ends), 1e-6)
    return min(ends) - margin, max(ends) + margin


def _spread(items: Sequence[Item], count: int) -> list[Item]:
    """Choose at most `count` items, evenly."""
    places = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(place)] for place in places]
