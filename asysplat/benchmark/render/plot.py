"""Time against error: a colour for each backend, a mark for each scene."""

from collections.abc import Callable, Mapping
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from asysplat.report.svg import FAINT, INK, OURS, PAPER, STYLE

COLOURS = {"reference": FAINT, "cpu": OURS, "cuda": INK, "gsplat": PAPER}
MARKS = "osD^vPX*"

Result = Mapping[str, Any]


def plot(results: Result) -> Figure:
    """The forward and the backward pass, of every backend with all its skips."""
    rows = [row for row in results["rows"] if row["without"] is None]
    marks = dict(zip(dict.fromkeys(row["scene"] for row in rows), MARKS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2), layout="constrained")
        forward, backward = figure.subplots(1, 2)
        _draw(forward, rows, marks, "forward", lambda error: error["image_p99"])
        _draw(backward, rows, marks, "backward", lambda error: max(error["gradients"].values()))
        forward.set_ylabel("image against float64, 99th percentile")
        backward.set_ylabel("worst gradient against float64, relative L2")
        backends = dict.fromkeys(row["backend"] for row in rows)
        keys = [_key("o", COLOURS[name], name) for name in backends]
        keys += [_key(mark, INK, f"scene {name}", "none") for name, mark in marks.items()]
        figure.legend(handles=keys, loc="outside right upper", frameon=False)
    return figure


def _draw(
    axes: Axes,
    rows: list[Result],
    marks: Mapping[str, str],
    direction: str,
    error: Callable[[Result], float],
) -> None:
    for row in rows:
        axes.plot(
            1000 * row[direction]["median"],
            error(row["error"]),
            marks[row["scene"]],
            color=COLOURS[row["backend"]],
            ms=8,
            alpha=0.8,
            mew=0,
        )
    axes.set(title=direction, xlabel="milliseconds", xscale="log", yscale="log")
    axes.margins(0.15)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 3) if high < 100 * low else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())


def _key(mark: str, colour: str, label: str, face: str | None = None) -> Line2D:
    face = face or colour
    return Line2D([], [], ls="", marker=mark, color=colour, mfc=face, ms=8, label=label)
