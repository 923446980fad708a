"""Time against error: a colour for each path, a mark for each operator, hollow in bf16."""

from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from asysplat.benchmark.ops.measure import PASSES
from asysplat.benchmark.ops.rows import LOOP
from asysplat.benchmark.ops.tables import TITLES, worst_error
from asysplat.report.svg import FAINT, INK, OURS, PAPER, STYLE

COLOURS = {LOOP: FAINT, "chunked": PAPER, "sdpa": PAPER, "cpu": OURS, "cuda": INK}
MARKS = "osD^vPX*"

Result = Mapping[str, Any]


def plot(results: Result) -> Figure:
    """The forward pass, and both passes."""
    rows = [row for row in results["rows"] if row["error"]]
    marks = dict(zip(dict.fromkeys(row["operator"] for row in rows), MARKS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2), layout="constrained")
        forward, both = figure.subplots(1, 2)
        for axes, name in zip((forward, both), PASSES, strict=True):
            _draw(axes, rows, marks, name)
        forward.set_ylabel("output against float64, relative L2")
        both.set_ylabel("worst gradient against float64, relative L2")
        keys = [_key("o", COLOURS[path], path) for path in dict.fromkeys(r["path"] for r in rows)]
        keys += [_key(mark, INK, name) for name, mark in marks.items()]
        keys.append(_key("o", INK, "in bf16", "none"))
        figure.legend(handles=keys, loc="outside right upper", frameon=False)
    return figure


def _draw(axes: Axes, rows: list[Result], marks: Mapping[str, str], name: str) -> None:
    for row in rows:
        colour = COLOURS[row["path"]]
        axes.plot(
            1000 * row[name]["median"],
            worst_error(row, name),
            marks[row["operator"]],
            color=colour,
            mfc=colour if row["precision"] == "fp32" else "none",
            ms=8,
            alpha=0.8,
        )
    axes.set(title=TITLES[name], xlabel="milliseconds", xscale="log", yscale="log")
    axes.margins(0.15)


def _key(mark: str, colour: str, label: str, face: str | None = None) -> Line2D:
    face = face or colour
    return Line2D([], [], ls="", marker=mark, color=colour, mfc=face, ms=8, label=label)
