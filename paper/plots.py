"""Plot filled tables: ours on the left, the paper's on the right."""

import csv
import re
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from paper.cells import ARROWS
from paper.compare import mean_and_std
from paper.fill import COMPUTED
from paper.front import draw_front
from paper.style import FAINT, OURS, PAPER, STYLE
from paper.tables import Column, PaperTable

# Tables in which one quantity varies: the meaning of the first number in a row's name.
RATIOS = {
    "geometry_ratio": "parameters in the geometry branch (%)",
    "mamba_ratio": "Mamba layers among the 8 of a stage",
}
# Quality is plotted against the first of these that a table has.
COSTS = ("gflops", "inference_seconds", "parameters")
# The smallest ratio of the costs of two rows for which quality is plotted against cost.
MIN_RANGE = 1.1


def make_plots(filled: PaperTable) -> list[tuple[str, Figure]]:
    """Plot what the table does not show; return caption and figure of each plot.

    Lines for a table of one ratio; for others a dot for each seed, quality against cost if the
    rows' costs differ, and a dot for each image if depths are measured. There is no plot below two
    rows that ran.
    """
    column = filled.ranked_column
    if column is None or sum(column.key in row.values for row in filled.rows) < 2:
        return []
    with matplotlib.rc_context(STYLE):
        if filled.key in RATIOS:
            return [_ratio_plot(filled)]
        plots = [_seed_plot(filled, column), *_pareto_plot(filled, column)]
        return plots + _image_plot(filled)


def _seed_plot(filled: PaperTable, column: Column) -> tuple[str, Figure]:
    """Plot a line for each row of the table: a dot for each seed, a bar at the mean."""
    rows = filled.rows
    figure = Figure(figsize=(9, 1.1 + 0.32 * len(rows)), layout="constrained")
    ours, paper = figure.subplots(1, 2, sharey=True)
    bar = {"marker": "|", "ls": "", "ms": 16, "mew": 2.5}
    for y, row in enumerate(rows):
        values = row.values.get(column.key, [])
        ours.plot(values, [y] * len(values), "o", color=OURS, ms=6, alpha=0.45, mew=0)
        if values:
            ours.plot(mean_and_std(values)[0], y, color=OURS, **bar)
        else:
            text = "quoted" if row.quoted else "not run"
            across = ours.get_yaxis_transform()
            ours.text(0.5, y, text, color=FAINT, ha="center", va="center", transform=across)
        if column.key in row.numbers:
            paper.plot(row.numbers[column.key], y, color=PAPER, **bar)
    ours.set_yticks(range(len(rows)), [row.label for row in rows])
    ours.set_ylim(len(rows) - 0.5, -0.5)
    labels = {"ours": filled.our_title(column), "paper": column.title()}
    for axes, (title, label) in zip((ours, paper), labels.items(), strict=True):
        axes.set(title=title, xlabel=label + ARROWS[column.better])
        axes.margins(x=0.08)
        axes.locator_params(axis="x", nbins=5)
        axes.tick_params(axis="y", length=0)
    return f"{column.kind} of each row: a dot for each seed, a bar at the mean.", figure


def _ratio_plot(filled: PaperTable) -> tuple[str, Figure]:
    """Plot a line for each test set, in its first metric."""
    first: dict[str, Column] = {}
    for column in filled.columns:
        if column.test_set:
            first.setdefault(column.test_set, column)
    ratios = [int(re.search(r"\d+", row.name)[0]) for row in filled.rows]
    figure = Figure(figsize=(9, 0.6 + 2.2 * len(first)), layout="constrained")
    grid = figure.subplots(len(first), 2, squeeze=False, sharex=True)
    for (ours, paper), column in zip(grid, first.values(), strict=True):
        summaries = []  # ratio, mean, std
        for ratio, row in zip(ratios, filled.rows, strict=True):
            if values := row.values.get(column.key):
                ours.plot([ratio] * len(values), values, "o", color=OURS, ms=6, alpha=0.45, mew=0)
                mean, std = mean_and_std(values)
                summaries.append((ratio, mean, std or 0.0))
        ours.errorbar(*np.reshape(summaries, (-1, 3)).T, fmt="o-", color=OURS, capsize=3)
        pairs = zip(ratios, filled.rows, strict=True)
        points = {x: r.numbers[column.key] for x, r in pairs if column.key in r.numbers}
        paper.plot(points.keys(), points.values(), "o-", color=PAPER)
        ours.set_ylabel(filled.our_title(column) + ARROWS[column.better])
        paper.set_ylabel(column.title() + ARROWS[column.better])
    grid[0, 0].set_title("ours")
    grid[0, 1].set_title("paper")
    for axes in grid[-1]:
        axes.set_xlabel(RATIOS[filled.key])
        axes.set_xticks(ratios)
    return (
        "Against the ratio: pale dots are seeds, the line joins the means ± their std.",
        figure,
    )


def _pareto_plot(filled: PaperTable, quality: Column) -> list[tuple[str, Figure]]:
    """Plot quality against cost; nothing below three rows, or if they cost the same."""
    columns = {column.key: column for column in filled.columns}
    cost = next((columns[key] for key in COSTS if key in columns), None)
    if cost is None:
        return []

    ours, paper = [], []
    for row in filled.rows:
        means = {key: mean_and_std(values)[0] for key, values in row.values.items() if values}
        # The costs of its network at the paper's scale
        means |= {key: number for key, number in (row.costs or {}).items() if key in COMPUTED}
        for points, numbers in ((ours, means), (paper, row.numbers)):
            if cost.key in numbers and quality.key in numbers:
                values = numbers[cost.key] / cost.unit, float(numbers[quality.key])
                points.append((row.label, *values))
    costs = [point[1] for point in ours]
    if len(ours) < 3 or max(costs) / min(costs) < MIN_RANGE:
        return []
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_front(left, ours, quality.better, OURS)
    draw_front(right, paper, quality.better, PAPER)
    titles = {"ours": filled.our_title(quality), "paper": quality.title()}
    for axes, (title, label) in zip((left, right), titles.items(), strict=True):
        axes.set(title=title, xlabel=cost.title(), ylabel=label + ARROWS[quality.better])
        axes.locator_params(nbins=5)
    caption = f"{quality.kind} against {cost.title()}: no row beats those on the line in both."
    return [(caption, figure)]


def _image_plot(filled: PaperTable) -> list[tuple[str, Figure]]:
    """Plot the PSNR of each test image over its AbsRel, as the paper's Figure 1."""
    column = next((c for c in filled.columns if c.key.endswith("/absrel")), None)
    if column is None:
        return []
    test_set = filled.sets.get(column.test_set, column.test_set)
    points = {
        row.label: [point for folder in row.folders for point in _image_points(folder, test_set)]
        for row in filled.rows
    }
    points = {label: np.array(of_row) for label, of_row in points.items() if of_row}
    if not points:
        return []
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    for label, of_row in points.items():
        (dots,) = axes.plot(*of_row.T, "o", ms=4, alpha=0.35, mew=0, rasterized=True)
        mean = of_row.mean(0)
        axes.plot(*mean, "o", ms=11, color=dots.get_color(), mec="white", label=label)
    axes.set(xscale="log", xlabel=f"{filled.our_title(column)} ↓", ylabel="PSNR (dB) ↑")
    axes.legend(frameon=False)
    caption = f"PSNR of each image of {test_set} over its AbsRel; large: the means of the rows."
    return [(caption, figure)]


def _image_points(folder: str, test_set: str) -> list[tuple[float, float]]:
    """Read AbsRel and PSNR of each image of a test set from a run's metrics.csv."""
    path = Path(folder) / "metrics.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["set"] == test_set and row.get("absrel")]
    return [(float(row["absrel"]), float(row["psnr"])) for row in rows]
