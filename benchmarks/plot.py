"""Figures of the suites: time against error, and bars."""

from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from benchmarks.table import largest_at
from benchmarks.timing import Result
from paper.style import FAINT, INK, OURS, STYLE

COLORS = {"cpu": OURS, "cuda": INK, "reference": FAINT}
MARKS = "osD^vPX*"


def time_against_error(rows: Sequence[Result], errors: Mapping[str, tuple[str, str]]) -> Figure:
    """Plot a point for each row; its color is its "backend", its marker its "scene".

    `errors` maps each timed pass to the label of its error, and to the path of this error in a row.
    """
    shared = {"ls": "", "ms": 8, "alpha": 0.8}
    marks = dict(zip(dict.fromkeys(row["scene"] for row in rows), MARKS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2), layout="constrained")
        for axes, (name, (label, path)) in zip(figure.subplots(1, 2), errors.items(), strict=True):
            for row in rows:
                style = {"marker": marks[row["scene"]], "color": COLORS[row["backend"]], **shared}
                axes.plot(1000 * row[name]["median"], largest_at(row, path), **style)
            axes.set(title=name, xlabel="milliseconds", xscale="log", yscale="log", ylabel=label)
            axes.margins(0.15)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
        keys = {name: ("o", COLORS[name]) for name in {row["backend"]: 0 for row in rows}}
        keys |= {f"scene {name}": (mark, INK) for name, mark in marks.items()}
        for label, (mark, color) in keys.items():
            axes.plot([], [], label=label, marker=mark, color=color, **shared)
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def bars(
    names: Sequence[str],
    parts: Mapping[str, Sequence[float]],
    label: str,
    tolerance: float | None = None,
) -> Figure:
    """Plot a horizontal bar for each name, stacked from parts, and a line at the tolerance, if any.

    Args:
        parts: lengths of each part, one for each bar; parts of length 0 everywhere are left out.
        label: label of the axis of lengths.
    """
    colors = matplotlib.colormaps["tab10"].colors
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 1.6 + 0.5 * len(names)), layout="constrained")
        axes = figure.subplots()
        starts = [0.0] * len(names)
        for (part, lengths), color in zip(parts.items(), colors, strict=False):
            if any(lengths):
                axes.barh(names, lengths, left=starts, color=color, label=part)
            starts = [start + length for start, length in zip(starts, lengths, strict=True)]
        if tolerance is not None:
            axes.axvline(tolerance, color=INK, label="tolerance")
        axes.set_xlabel(label)
        axes.invert_yaxis()
        figure.legend(loc="outside right upper", frameon=False)
    return figure
