"""From filled tables to what is printed of them: the cells."""

from collections.abc import Sequence

from asysplat.report.cost_layout import cost_grid
from asysplat.report.filled import FilledRow, FilledTable, Number, check, mean_and_spread
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


def make_sheet(filled: FilledTable) -> Sheet:
    """Everything that is printed of one table."""
    grids = [_measured_grid(filled)]
    if any(row.costs for row in filled.rows):
        grids.append(cost_grid(filled.networks))
    above = tuple(protocol_notes(filled))
    return Sheet(filled.title, above, tuple(grids), tuple(notes(filled)))


def make_overview(tables: Sequence[FilledTable]) -> Grid:
    """One line a table: how much of it ran, and how it compares."""
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
    ours = [row for row in filled.rows if not row.row.quoted]
    run = sum(bool(row.seeds) for row in ours)
    return Cell(f"{run} of {len(ours)}", "" if run else "muted")


def _seeds(filled: FilledTable) -> Cell:
    """Seeds a row, of the rows that ran."""
    counts = sorted({len(row.seeds) for row in filled.rows if row.seeds})
    if not counts:
        return Cell("-", "muted")
    return Cell(str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}")


def _costs_that_fit(filled: FilledTable) -> Cell:
    verdicts = [check(row) for row in filled.networks]
    known = [verdict for verdict in verdicts if verdict in ("fits", "off")]
    if not known:
        return Cell("-", "muted")
    text = f"{known.count('fits')} of {len(known)}"
    unverified = sum(verdict.startswith("unverified") for verdict in verdicts)
    return Cell(text + f", {unverified} †" * bool(unverified), "alarm" * ("off" in known))


def _measured_grid(filled: FilledTable) -> Grid:
    headings = [Heading("Row")]
    columns = [[Cell(row.name) for row in filled.rows]]
    for column in filled.measured_columns:
        arrow = ARROWS[column.better]
        headings += [Heading(column.title + arrow, "paper")]
        headings += [Heading(filled.our_title(column) + arrow, "ours")]
        columns += [_paper_cells(filled.rows, column), _our_cells(filled.rows, column)]
    return Grid("Measured", tuple(headings), tuple(zip(*columns, strict=True)))


def _paper_cells(rows: Sequence[FilledRow], column: Column) -> list[Cell]:
    """As the paper prints them; where it prints bounds there is no telling which is the best."""
    numbers = [row.row.paper.get(column.key) for row in rows]
    bounded = any(column.key in row.row.bounds for row in rows)
    best_ones = [False] * len(rows) if bounded else _best(numbers, column)
    cells = []
    for row, best in zip(rows, best_ones, strict=True):
        text = row.row.text(column)
        cells.append(Cell(text, "best" if best else "") if text else Cell("-", "muted"))
    return cells


def _our_cells(rows: Sequence[FilledRow], column: Column) -> list[Cell]:
    measured = [row.values.get(column.key) or None for row in rows]
    means = [mean_and_spread(values)[0] if values else None for values in measured]
    cells = []
    for row, values, best in zip(rows, measured, _best(means, column), strict=True):
        if values:
            cells.append(Cell(_mean_text(values, column), "best" if best else ""))
        else:
            cells.append(Cell("quoted" if row.row.quoted else "not run", "muted"))
    return cells


def _mean_text(values: Sequence[Number], column: Column) -> str:
    """The spread has the decimals of the mean."""
    mean, spread = mean_and_spread(values)
    text = column.text(mean)
    if spread is None:
        return text
    decimals = len(text.partition(".")[2])
    return f"{text} ± {spread / column.unit:.{decimals}f}"


def _best(numbers: Sequence[Number | None], column: Column) -> list[bool]:
    """Those that print like the best one; none where all print alike."""
    printed = [None if number is None else column.text(float(number)) for number in numbers]
    present = [float(number) for number in numbers if number is not None]
    if column.better is None or len({text for text in printed if text is not None}) < 2:
        return [False] * len(numbers)
    best = column.text(max(present) if column.better == "higher" else min(present))
    return [text == best for text in printed]
