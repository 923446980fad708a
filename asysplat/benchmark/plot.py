"""The figures of all suites: time against error, and bars."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from asysplat.benchmark.table import worst
from asysplat.benchmark.timing import Result
from asysplat.report.style import FAINT, INK, OURS, PAPER, STYLE

COLORS = {"cpu": OURS, "cuda": INK, "reference": FAINT, "loop": FAINT}
COLORS |= dict.fromkeys(("chunked", "sdpa"), PAPER)
MARKS = "osD^vPX*"


def time_against_error(
    rows: Sequence[Result], errors: Mapping[str, tuple[str, str]], backend: str, case: str
) -> Figure:
    """Plot a point for each row, colored by its backend, marked by its case, hollow in bf16.

    Args:
        errors: for each timed pass, the label of its error, and the error's path in a row.
        backend, case: keys of a row.
    """
    marks = dict(zip(dict.fromkeys(row[case] for row in rows), MARKS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2), layout="constrained")
        grid = figure.subplots(1, len(errors), squeeze=False)
        for axes, (name, (label, path)) in zip(grid[0], errors.items(), strict=True):
            for row in [row for row in rows if row[name]]:
                hollow = row.get("precision") == "bf16"
                style = _point_style(marks[row[case]], COLORS[row[backend]], hollow)
                axes.plot(1000 * row[name]["median"], worst(row, path), **style)
            title = name.replace("_", " and ")
            axes.set(title=title, xlabel="milliseconds", xscale="log", yscale="log", ylabel=label)
            axes.margins(0.15)
            low, high = axes.get_xlim()
            if high < 100 * low:  # less than two decades: two ticks in each
                plain_log_ticks(axes, (1, 3))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
        keys = {name: _point_style("o", COLORS[name]) for name in {r[backend]: 0 for r in rows}}
        keys |= {f"{case} {name}": _point_style(mark, INK) for name, mark in marks.items()}
        if any(row.get("precision") == "bf16" for row in rows):
            keys["in bf16"] = _point_style("o", INK, hollow=True)
        handles = [Line2D([], [], label=label, **style) for label, style in keys.items()]
        figure.legend(handles=handles, loc="outside right upper", frameon=False)
    return figure


def bars(
    names: Sequence[str],
    parts: Mapping[str, Sequence[float]],
    limit: tuple[str, Sequence[float]],
    label: str,
    spread: Sequence[float] | None = None,
) -> Figure:
    """Plot a horizontal bar for each name, made of parts, with a mark at its limit.

    Args:
        parts: the lengths of a part in all bars; one that is 0 everywhere is left out.
        limit: its name, and its value for each bar.
        label: of the lengths.
        spread: the interquartile range of each bar's length, drawn about its end.
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
        if spread is not None:
            axes.errorbar(starts, names, xerr=[iqr / 2 for iqr in spread], fmt="none", color=INK)
        axes.plot(limit[1], names, "|", color=INK, ms=18, mew=2, label=limit[0])
        axes.set_xlabel(label)
        axes.invert_yaxis()
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def plain_log_ticks(axes: Axes, steps: Sequence[int]) -> None:
    """Label a logarithmic x axis with plain numbers at `steps` of each decade."""
    axes.xaxis.set_major_locator(LogLocator(subs=steps))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _point_style(mark: str, color: str, hollow: bool = False) -> dict[str, Any]:
    face = "none" if hollow else color
    return {"ls": "", "marker": mark, "color": color, "mfc": face, "ms": 8, "alpha": 0.8}
