"""Plots of filled tables: ours on the left, the paper's on the right."""

import re
from collections.abc import Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asysplat.report.cells import ARROWS
from asysplat.report.filled import COMPUTED, FilledRow, FilledTable, Number, mean_and_spread
from asysplat.report.front import Point, draw_front
from asysplat.report.paper import Column
from asysplat.report.style import FAINT, OURS, PAPER, STYLE

# Tables in which one quantity varies: what the first number in a row's name is.
RATIOS = {
    "geometry_ratio": "parameters in the geometry branch (%)",
    "mamba_ratio": "Mamba layers among the 8 of a stage",
}
# The first of these that a table has is what its rows are compared by.
COSTS = ("gflops", "inference_seconds", "parameters")
# The dearest row over the cheapest: below it, cost does not tell rows apart.
LEAST_RANGE = 1.1


def make_plots(filled: FilledTable) -> list[tuple[str, Figure]]:
    """Plot what the table does not show; return caption and figure of each plot.

    Lines for a table of one ratio; for others a dot for each seed, and quality against cost where
    the rows' costs differ. There is no plot below two rows that ran.
    """
    ranked = [column for column in filled.paper.columns if column.key == filled.paper.rank_by]
    if not ranked or sum(ranked[0].key in row.values for row in filled.rows) < 2:
        return []
    with matplotlib.rc_context(STYLE):
        if filled.paper.key in RATIOS:
            return [_ratio_plot(filled)]
        return [_seed_plot(filled, ranked[0]), *_pareto_plot(filled, ranked[0])]


def _seed_plot(filled: FilledTable, column: Column) -> tuple[str, Figure]:
    """Plot a line for each row of the table: a dot for each seed, a bar at the mean."""
    rows = filled.rows
    figure = Figure(figsize=(9, 1.1 + 0.32 * len(rows)), layout="constrained")
    ours, paper = figure.subplots(1, 2, sharey=True)
    for place, row in enumerate(rows):
        values = row.values.get(column.key, [])
        _dots(ours, values, [place] * len(values), OURS)
        if values:
            ours.plot(mean_and_spread(values)[0], place, "|", color=OURS, ms=16, mew=2.5)
        else:
            _say(ours, place, "quoted" if row.paper.quoted else "not run")
        if column.key in row.paper.numbers:
            paper.plot(row.paper.numbers[column.key], place, "|", color=PAPER, ms=16, mew=2.5)
    ours.set_yticks(range(len(rows)), [row.name for row in rows])
    ours.set_ylim(len(rows) - 0.5, -0.5)
    labels = {"ours": filled.our_title(column), "paper": column.title}
    for axes, (title, label) in zip((ours, paper), labels.items(), strict=True):
        axes.set(title=title, xlabel=label + ARROWS[column.better])
        axes.margins(x=0.08)
        axes.locator_params(axis="x", nbins=5)
        axes.tick_params(axis="y", length=0)
    return f"{column.kind} of each row: a dot for each seed, a bar at the mean.", figure


def _say(axes: Axes, place: int, text: str) -> None:
    across = axes.get_yaxis_transform()
    axes.text(0.5, place, text, color=FAINT, ha="center", va="center", transform=across)


def _ratio_plot(filled: FilledTable) -> tuple[str, Figure]:
    """Plot a line for each test set, in its first metric."""
    columns = _first_metrics(filled)
    figure = Figure(figsize=(9, 0.6 + 2.2 * len(columns)), layout="constrained")
    grid = figure.subplots(len(columns), 2, squeeze=False, sharex=True)
    for (ours, paper), column in zip(grid, columns, strict=True):
        _our_line(ours, filled.rows, column)
        points = {
            _ratio(r): r.paper.numbers[column.key]
            for r in filled.rows
            if column.key in r.paper.numbers
        }
        paper.plot(points.keys(), points.values(), "o-", color=PAPER)
        ours.set_ylabel(filled.our_title(column) + ARROWS[column.better])
        paper.set_ylabel(column.title + ARROWS[column.better])
    grid[0, 0].set_title("ours")
    grid[0, 1].set_title("paper")
    for axes in grid[-1]:
        axes.set_xlabel(RATIOS[filled.paper.key])
        axes.set_xticks([_ratio(row) for row in filled.rows])
    return (
        "Against the ratio: pale dots are seeds, the line joins the means ± their spread.",
        figure,
    )


def _our_line(axes: Axes, rows: Sequence[FilledRow], column: Column) -> None:
    run = [row for row in rows if row.values.get(column.key)]
    for row in run:
        values = row.values[column.key]
        _dots(axes, [_ratio(row)] * len(values), values, OURS)
    summaries = [mean_and_spread(row.values[column.key]) for row in run]
    means = [mean for mean, _ in summaries]
    spreads = [spread or 0.0 for _, spread in summaries]
    axes.errorbar([_ratio(row) for row in run], means, spreads, fmt="o-", color=OURS, capsize=3)


def _dots(axes: Axes, x: Sequence[Number], y: Sequence[Number], color: str) -> None:
    axes.plot(x, y, "o", color=color, ms=6, alpha=0.45, mew=0)


def _first_metrics(filled: FilledTable) -> list[Column]:
    """Find the first column of each test set."""
    first: dict[str, Column] = {}
    for column in filled.paper.columns:
        if column.test_set:
            first.setdefault(column.test_set, column)
    return list(first.values())


def _ratio(row: FilledRow) -> int:
    return int(re.search(r"\d+", row.paper.name)[0])


def _pareto_plot(filled: FilledTable, quality: Column) -> list[tuple[str, Figure]]:
    """Plot quality against cost; nothing below three rows, or where they cost the same."""
    costs = {column.key: column for column in filled.paper.columns if column.key in COSTS}
    if not costs:
        return []
    cost = costs[next(key for key in COSTS if key in costs)]
    ours = [point for row in filled.rows if (point := _our_point(row, cost, quality))]
    paper = [
        point for row in filled.rows if (point := _point(row, row.paper.numbers, cost, quality))
    ]
    if len(ours) < 3 or _range(ours) < LEAST_RANGE:
        return []
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_front(left, ours, quality.better, OURS)
    draw_front(right, paper, quality.better, PAPER)
    for axes, title, label in (
        (left, "ours", filled.our_title(quality)),
        (right, "paper", quality.title),
    ):
        axes.set(title=title, xlabel=cost.title, ylabel=label + ARROWS[quality.better])
        axes.locator_params(nbins=5)
    caption = f"{quality.kind} against {cost.title}: no row beats those on the line in both."
    return [(caption, figure)]


def _our_point(row: FilledRow, cost: Column, quality: Column) -> Point | None:
    """Find our point of a row: its network's cost at the paper's scale, or a measured one."""
    numbers = {key: mean_and_spread(values)[0] for key, values in row.values.items() if values}
    numbers |= {key: number for key, number in (row.costs or {}).items() if key in COMPUTED}
    return _point(row, numbers, cost, quality)


def _point(
    row: FilledRow, numbers: dict[str, Number], cost: Column, quality: Column
) -> Point | None:
    if cost.key not in numbers or quality.key not in numbers:
        return None
    return row.name, numbers[cost.key] / cost.unit, float(numbers[quality.key])


def _range(points: Sequence[Point]) -> float:
    costs = [cost for _, cost, _ in points]
    return max(costs) / min(costs)
