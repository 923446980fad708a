"""Print a report on one screen, and draw it as a figure."""

from collections.abc import Sequence

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
from asysplat.data.check.report import Report
from asysplat.data.selection import evenly_spaced
from asysplat.scene import Cameras

WIDTH, PATH_HEIGHT, MAX_IMAGE_HEIGHT, TITLE_HEIGHT = 12.0, 5.0, 4.5, 0.3  # inches
MAX_PAIRS = 3  # pairs of images that are drawn
MAX_LINES = 10  # in a pair
MAX_ARROWS = 60  # along the path
MAX_POINTS = 5000  # sparse points, about
POINT_QUANTILES = (0.05, 0.95)  # quantiles of the sparse points that the axes include
MARGIN = 0.1  # around the path and the points, of their size


def print_report(report: Report, title: str, console: Console) -> None:
    """Print the measurements line by line, and the verdict last."""
    table = Table(title=Text(title, "bold"), title_justify="left", box=None, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in report.rows:
        table.add_row(name, Text(text))
    console.print(table)
    message = report.verdict.summary
    style = "bold green" if report.verdict.fits else "bold red"
    console.print(Text(f"{message[0].upper()}{message[1:]}.", style))


def draw_report(report: Report, title: str) -> Figure:
    """Draw the path from two sides, and pairs of images with matches and epipolar lines."""
    cameras = report.sequence.cameras
    image_height = min(WIDTH / MAX_PAIRS * cameras.height / cameras.width, MAX_IMAGE_HEIGHT)
    pair_height = 2 * (image_height + TITLE_HEIGHT)
    figure = Figure(figsize=(WIDTH, PATH_HEIGHT + pair_height), layout="constrained")
    summary = f"{title}: {report.verdict.summary}"
    figure.suptitle(summary.replace("$", r"\$"), wrap=True)  # else a formula
    heights = (PATH_HEIGHT, pair_height)
    paths, images = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    _draw_path(report, *paths.subplots(1, 2))
    all_pairs = report.matches.pairs
    shown = evenly_spaced(range(len(all_pairs)), min(MAX_PAIRS, len(all_pairs)))
    if pairs := [all_pairs[index] for index in shown]:
        columns = images.subplots(2, len(pairs), squeeze=False).T.tolist()
        for plots, pair in zip(columns, pairs, strict=True):
            _draw_pair(report, pair, plots)
    return figure


def _draw_path(report: Report, above: Axes, side: Axes) -> None:
    cameras, points = report.sequence.cameras, report.sequence.scene.points
    axes = _upright(cameras)
    centers = cameras.centers.double().numpy() @ axes
    ahead = cameras.cam_to_world[:, :3, 2].double().numpy() @ axes
    sparse = np.empty((0, 3)) if points is None else points @ axes
    drawn = sparse[:: max(1, len(sparse) // MAX_POINTS)]
    arrows = evenly_spaced(range(len(centers)), min(MAX_ARROWS, len(centers)))
    for plot, x, y, direction in ((above, 0, 1, "above"), (side, 1, 2, "the side")):
        plot.set_title(f"path from {direction}, dark to light; scene units")
        plot.scatter(drawn[:, x], drawn[:, y], s=1, c="0.7", linewidths=0)
        plot.plot(centers[:, x], centers[:, y], c="0.4", lw=0.8)
        plot.quiver(
            *(centers[arrows, x], centers[arrows, y], ahead[arrows, x], ahead[arrows, y], arrows),
            **{"cmap": "viridis", "angles": "xy", "scale": 16, "width": 0.004},
        )
        plot.set_aspect("equal")
        plot.set_xlim(*_limits(centers[:, x], sparse[:, x]))
        plot.set_ylim(*_limits(centers[:, y], sparse[:, y]))


def _draw_pair(report: Report, pair: tuple[int, int], plots: Sequence[Axes]) -> None:
    sequence = report.sequence
    height, width = sequence.cameras.height, sequence.cameras.width
    matches = report.matches.select((report.matches.indices == torch.tensor(pair)).all(-1))
    left_to_right = matches.points[:, 0, 0].argsort()
    matches = matches.select(left_to_right[evenly_spaced(range(len(matches)), MAX_LINES)])
    lines = epipolar_lines(sequence.cameras.to(torch.float64), matches)
    images = sequence.views(pair).images.permute(0, 2, 3, 1).numpy()
    for view, plot in enumerate(plots):
        # The first pixel's center is at +0.5.
        plot.imshow(images[view], extent=(0, width, height, 0))
        plot.set_title(f"image {pair[view]}")
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
        plot.set(xlim=(0, width), ylim=(height, 0))


def _upright(cameras: Cameras) -> Float[ndarray, "3 3"]:
    rotations = cameras.cam_to_world[:, :3, :3].double().numpy()
    up, right = -rotations[:, :, 1].mean(0), rotations[0, :, 0]
    ahead = np.cross(up, right)
    axes = (np.cross(ahead, up), ahead, up)
    return np.stack([axis / max(np.linalg.norm(axis), 1e-9) for axis in axes], 1)


def _limits(centers: Float[ndarray, " N"], points: Float[ndarray, " P"]) -> tuple[float, float]:
    values = [*centers, *(np.quantile(points, POINT_QUANTILES) if len(points) else ())]
    margin = MARGIN * max(max(values) - min(values), 1e-6)
    return min(values) - margin, max(values) + margin
