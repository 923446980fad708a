"""Quality against cost: which rows no other row beats in both."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asysplat.report.filled import COMPUTED, FilledRow, FilledTable, Number, mean_and_spread
from asysplat.report.layout import ARROWS
from asysplat.report.paper import Column
from asysplat.report.svg import FAINT, INK, OURS, PAPER

# The first of these that a table has is what its rows are compared by.
COSTS = ("gflops", "inference_seconds", "parameters")
# The dearest row over the cheapest: below it, cost does not tell rows apart.
LEAST_RANGE = 1.1

Point = tuple[str, float, float]


def pareto_front(points: Sequence[Point], better: str) -> list[Point]:
    """The points (name, cost, quality) that no other equals or beats in both, cheapest first."""
    sign = 1 if better == "higher" else -1
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point[1], -sign * point[2])):
        if not front or sign * point[2] > sign * front[-1][2]:
            front.append(point)
    return front


def pareto_plot(filled: FilledTable, quality: Column) -> list[tuple[str, Figure]]:
    """The caption and the figure, or nothing below three rows or where they cost the same."""
    costs = {column.key: column for column in filled.table.columns if column.key in COSTS}
    if not costs:
        return []
    cost = costs[next(key for key in COSTS if key in costs)]
    ours = [point for row in filled.rows if (point := _our_point(row, cost, quality))]
    paper = [point for row in filled.rows if (point := _point(row, row.row.paper, cost, quality))]
    if len(ours) < 3 or _range(ours) < LEAST_RANGE:
        return []
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw(left, ours, quality.better, OURS)
    _draw(right, paper, quality.better, PAPER)
    for axes, title, label in (
        (left, "ours", filled.our_title(quality)),
        (right, "paper", quality.title),
    ):
        axes.set(title=title, xlabel=cost.title, ylabel=label + ARROWS[quality.better])
    words = f"{quality.kind} against {cost.title}: no row beats those on the line in both."
    return [(words, figure)]


def _our_point(row: FilledRow, cost: Column, quality: Column) -> Point | None:
    """The network's costs are those at the paper's scale; the others were measured."""
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


def _draw(axes: Axes, points: Sequence[Point], better: str, colour: str) -> None:
    front = pareto_front(points, better)
    axes.plot([p[1] for p in front], [p[2] for p in front], "o-", color=colour, ms=7)
    rest = [point for point in points if point not in front]
    axes.plot([p[1] for p in rest], [p[2] for p in rest], "o", color=FAINT, ms=6, alpha=0.7)
    for point in rest:
        _label(axes, point, FAINT, "center", "top")
    for point in front:
        _label(axes, point, INK, "left" if point == front[-1] else "right", "bottom")
    axes.margins(x=0.2, y=0.18)
    axes.locator_params(nbins=5)


def _label(axes: Axes, point: Point, colour: str, ha: str, va: str) -> None:
    """Names on the front stand above it and away from its end, so that neighbours stay apart."""
    name, cost, quality = point
    offset = (0, 6 if va == "bottom" else -6)
    axes.annotate(
        name,
        (cost, quality),
        offset,
        textcoords="offset points",
        ha=ha,
        va=va,
        color=colour,
        fontsize=9,
    )
