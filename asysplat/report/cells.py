"""The cells of every grid: measured numbers, costs, the overview of all tables."""

from collections.abc import Sequence

from asysplat.report.filled import (
    LIMITS,
    Costs,
    FilledRow,
    FilledTable,
    Number,
    check,
    cost_errors,
    fits,
    mean_and_spread,
)
from asysplat.report.notes import notes, protocol_notes, rho_text
from asysplat.report.paper import Column
from asysplat.report.sheet import Cell, Grid, Heading, Sheet, anchor

TITLE = "AsySplat: our numbers beside the paper's"
INTRODUCTION = (
    "Each column of the paper stands beside ours: measured at our scale, on the test set that its "
    "heading names, so compare the order of the rows and not the numbers. Bold is the best of its "
    "column. "
    "† marks a row whose layout the paper leaves open."
)
OVERVIEW = (
    "All tables. Rank agreement is Spearman's rho with the paper's order; ? where rows differ "
    "hardly more than seeds alone make them, or one seed does not tell."
)
# The space does not break.
ARROWS = {"higher": "\u00a0↑", "lower": "\u00a0↓", None: ""}
# Key in `Costs`: title, what its unit is worth, format.
PRINTED = {
    "parameters": ("Param (M)", 1e6, "{:.4g}"),
    "gflops": ("GFLOPs", 1, "{:,.0f}"),
    "gaussians": ("Gaussians (M)", 1e6, "{:.3g}"),
    "gflops_true": ("True GFLOPs", 1, "{:,.0f}"),
    "geometry_share": ("Geometry (%)", 0.01, "{:.1f}"),
    "activation_gb": ("Activation (GB)", 1, "{:.3g}"),
}
COST_CAPTION = (
    "Costs at the paper's scale. GFLOPs are those of linear and convolution modules, as the paper "
    "counts them; true ones have attention and scans too. Geometry is the share of the parameters "
    "in that branch."
)
NOTHING = Cell("-", "muted")


def make_sheet(filled: FilledTable) -> Sheet:
    """Make everything that is printed of one table."""
    grids = [_measured_grid(filled)]
    if any(row.costs for row in filled.rows):
        grids.append(_cost_grid(filled.networks))
    above = tuple(protocol_notes(filled))
    return Sheet(filled.title, above, tuple(grids), tuple(notes(filled)))


def make_overview(tables: Sequence[FilledTable]) -> Grid:
    """Make a line for each table: how much of it ran, and how it compares."""
    headings = ("Table", "Rows run", "Seeds", "Rank agreement", "Costs that fit")
    rows = [
        (
            Cell(filled.title, link=anchor(filled.title)),
            _rows_run(filled),
            _seeds(filled),
            Cell(rho_text(filled)),
            _costs_that_fit(filled),
        )
        for filled in tables
    ]
    return Grid(OVERVIEW, tuple(map(Heading, headings)), tuple(rows))


def _rows_run(filled: FilledTable) -> Cell:
    ours = [row for row in filled.rows if not row.paper.quoted]
    run = sum(bool(row.seeds) for row in ours)
    return Cell(f"{run} of {len(ours)}", "" if run else "muted")


def _seeds(filled: FilledTable) -> Cell:
    """Count the seeds of a row, over the rows that ran."""
    counts = sorted({len(row.seeds) for row in filled.rows if row.seeds})
    if not counts:
        return NOTHING
    return Cell(str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}")


def _costs_that_fit(filled: FilledTable) -> Cell:
    verdicts = [check(row) for row in filled.networks]
    known = [verdict for verdict in verdicts if verdict in ("fits", "off")]
    if not known:
        return NOTHING
    text = f"{known.count('fits')} of {len(known)}"
    unverified = sum(verdict.startswith("unverified") for verdict in verdicts)
    return Cell(text + f", {unverified} †" * bool(unverified), "alarm" * ("off" in known))


def _measured_grid(filled: FilledTable) -> Grid:
    headings = [Heading("Row")]
    columns = [[Cell(row.name) for row in filled.rows]]
    for column in filled.measured_columns:
        arrow = ARROWS[column.better]
        if filled.paper.number is not None:
            headings += [Heading(column.title + arrow, "paper")]
            columns += [_paper_cells(filled.rows, column)]
        headings += [Heading(filled.our_title(column) + arrow, "ours")]
        columns += [_our_cells(filled.rows, column)]
    return Grid("Measured", tuple(headings), tuple(zip(*columns, strict=True)))


def _paper_cells(rows: Sequence[FilledRow], column: Column) -> list[Cell]:
    """Write the paper's numbers; none is the best where it prints bounds instead of numbers."""
    numbers = [row.paper.numbers.get(column.key) for row in rows]
    bounded = any(column.key in row.paper.bounds for row in rows)
    best_ones = [False] * len(rows) if bounded else _best(numbers, column)
    cells = []
    for row, best in zip(rows, best_ones, strict=True):
        text = row.paper.text(column)
        cells.append(Cell(text, "best" if best else "") if text else NOTHING)
    return cells


def _our_cells(rows: Sequence[FilledRow], column: Column) -> list[Cell]:
    measured = [row.values.get(column.key) or None for row in rows]
    means = [mean_and_spread(values)[0] if values else None for values in measured]
    cells = []
    for row, values, best in zip(rows, measured, _best(means, column), strict=True):
        if values:
            cells.append(Cell(_mean_text(values, column), "best" if best else ""))
        else:
            cells.append(Cell("quoted" if row.paper.quoted else "not run", "muted"))
    return cells


def _mean_text(values: Sequence[Number], column: Column) -> str:
    """Write mean ± spread, with as many decimals as the column's numbers."""
    mean, spread = mean_and_spread(values)
    text = column.text(mean)
    if spread is None:
        return text
    decimals = len(text.partition(".")[2])
    return f"{text} ± {spread / column.unit:.{decimals}f}"


def _best(numbers: Sequence[Number | None], column: Column) -> list[bool]:
    """Find the numbers that print like the best one; none where all print alike."""
    printed = [None if number is None else column.text(float(number)) for number in numbers]
    present = [float(number) for number in numbers if number is not None]
    if column.better is None or len({text for text in printed if text is not None}) < 2:
        return [False] * len(numbers)
    best = column.text(max(present) if column.better == "higher" else min(present))
    return [text == best for text in printed]


def _cost_grid(rows: Sequence[FilledRow]) -> Grid:
    """Make a line for each row and for each other reading of it."""
    parts = {key: _cost_parts(key, rows) for key in PRINTED}
    headings = [Heading("Row")]
    headings += [Heading(PRINTED[key][0], part) for key in parts for part in parts[key]]
    headings += [Heading("Check")]
    lines = []
    for row in rows:
        lines.append(_cost_line(Cell(row.name), row, row.costs, parts, check(row)))
        for reading, costs in zip(row.paper.readings, row.reading_costs, strict=False):
            name = Cell(f"or: {reading.name}", "muted")
            verdict = "fits" if fits(row.paper, costs) else "no fit"
            lines.append(_cost_line(name, row, costs, parts, verdict))
    return Grid(COST_CAPTION, tuple(headings), tuple(lines))


def _cost_parts(key: str, rows: Sequence[FilledRow]) -> tuple[str, ...]:
    """Name the columns of one cost: a cost that the paper never prints in this table has one."""
    if not any(key in row.paper.numbers for row in rows):
        return ("",)
    return ("paper", "ours") if key == "gaussians" else ("paper", "ours", "error")


def _cost_line(
    name: Cell,
    row: FilledRow,
    costs: Costs | None,
    parts: dict[str, tuple[str, ...]],
    verdict: str,
) -> tuple[Cell, ...]:
    cells = [name]
    for key in PRINTED:
        paper = _cost_cell(key, row.paper.numbers)
        ours = _cost_cell(key, costs or {})
        by_part = {"paper": paper, "ours": ours, "": ours, "error": _error_cell(key, row, costs)}
        cells += [by_part[part] for part in parts[key]]
    look = {"off": "alarm", "fits": ""}.get(verdict, "muted")
    return (*cells, Cell(verdict, look))


def _cost_cell(key: str, numbers: Costs) -> Cell:
    if key not in numbers:
        return NOTHING
    _, unit, form = PRINTED[key]
    return Cell(form.format(numbers[key] / unit))


def _error_cell(key: str, row: FilledRow, costs: Costs | None) -> Cell:
    error = cost_errors(row.paper, costs).get(key) if costs else None
    if error is None:
        return NOTHING
    return Cell(f"{error:+.1%}", "alarm" if abs(error) > LIMITS[key] else "")
