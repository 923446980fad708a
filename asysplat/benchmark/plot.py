"""The pictures of all suites: time against error, bars, and metrics against seconds."""

from collections.abc import Mapping, Sequence
from itertools import count, cycle
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
COLORS |= dict.fromkeys(("chunked", "sdpa", "gsplat"), PAPER)
MARKS = "osD^vPX*"


def time_against_error(
    rows: Sequence[Result], errors: Mapping[str, tuple[str, str]], backend: str, case: str
) -> Figure:
    """Plot a point for each row: its color is its backend, its mark its case, hollow in bf16.

    Args:
        errors: for each timed pass, what its error is, and its path in a row.
        backend, case: keys of a row.
    """
    in_bf16 = [row.get("precision") == "bf16" for row in rows]
    marks = dict(zip(dict.fromkeys(row[case] for row in rows), MARKS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2), layout="constrained")
        grid = figure.subplots(1, len(errors), squeeze=False)
        for axes, (name, (label, path)) in zip(grid[0], errors.items(), strict=True):
            for row, hollow in zip(rows, in_bf16, strict=True):
                if not row[name]:
                    continue
                look = _look(marks[row[case]], COLORS[row[backend]], hollow)
                axes.plot(1000 * row[name]["median"], worst(row, path), **look)
            title = name.replace("_", " and ")
            axes.set(title=title, xlabel="milliseconds", xscale="log", yscale="log", ylabel=label)
            axes.margins(0.15)
            low, high = axes.get_xlim()
            if high < 100 * low:  # less than two decades: two ticks in each, as plain numbers
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
                axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
        keys = {name: _look("o", COLORS[name]) for name in dict.fromkeys(r[backend] for r in rows)}
        keys |= {f"{case} {name}": _look(mark, INK) for name, mark in marks.items()}
        if any(in_bf16):
            keys["in bf16"] = _look("o", INK, hollow=True)
        handles = [Line2D([], [], label=label, **look) for label, look in keys.items()]
        figure.legend(handles=handles, loc="outside right upper", frameon=False)
    return figure


def bars(
    names: Sequence[str],
    parts: Mapping[str, Sequence[float]],
    limit: tuple[str, Sequence[float]],
    label: str,
    spread: Sequence[float] | None = None,
) -> Figure:
    """Plot a horizontal bar for each name, made of parts, with a mark where its limit is.

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


def against_seconds(
    panels: Mapping[str, Mapping[str, Sequence[Result]]], metrics: Mapping[str, str]
) -> Figure:
    """Plot metrics against a budget: a column for each panel, a line or a mark for each name.

    Args:
        panels: by title, the rows of each name by "budget" in seconds; one of none, or of 0, is a
            dashed level.
        metrics: keys of a row, and their labels.
    """
    timed: dict[str, set[float]] = {}
    for name, rows in (item for panel in panels.values() for item in panel.items()):
        timed.setdefault(name, set()).update(row["budget"] for row in rows if row.get("budget"))
    looks, colors = {}, (f"C{number}" for number in count())  # matplotlib's own, in turns
    for (name, budgets), mark in zip(timed.items(), cycle(MARKS), strict=False):
        looks[name] = {"color": FAINT, "ls": "--"}  # of what has no budget at all
        if budgets:
            looks[name] = _look(mark, next(colors)) | {"ls": "-" if len(budgets) > 1 else ""}
    with matplotlib.rc_context(STYLE):
        size = (2.2 + 2.8 * len(panels), 0.8 + 2.6 * len(metrics))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(metrics), len(panels), sharex=True, squeeze=False)
        for column, (title, found) in enumerate(panels.items()):
            grid[0, column].set_title(title)
            grid[-1, column].set_xlabel("seconds of refinement")
            for axes, (metric, label) in zip(grid[:, column], metrics.items(), strict=True):
                axes.set(xscale="log", ylabel=label if column == 0 else None)
                ticks = sorted(set().union(*timed.values()))
                axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
                axes.xaxis.set_minor_formatter(NullFormatter())
                for name, rows in found.items():
                    _plot_rows(axes, rows, metric, looks[name])
        handles = [Line2D([], [], label=name, **look) for name, look in looks.items()]
        handles.append(Line2D([], [], label="not refined", color=INK, ls="--"))
        figure.legend(handles=handles, loc="outside right upper", frameon=False)
    return figure


def _plot_rows(axes: Axes, rows: Sequence[Result], metric: str, look: Mapping[str, Any]) -> None:
    rows = [row for row in rows if row.get(metric) is not None]
    timed = [row for row in rows if row.get("budget")]
    axes.plot([row["budget"] for row in timed], [row[metric] for row in timed], **look)
    for row in rows:
        if not row.get("budget"):
            axes.axhline(row[metric], color=look["color"], ls="--", zorder=1)


def _look(mark: str, color: str, hollow: bool = False) -> dict[str, Any]:
    face = "none" if hollow else color
    return {"ls": "", "marker": mark, "color": color, "mfc": face, "ms": 8, "alpha": 0.8}
