"""From filled tables to what is printed of them: the costs, at the paper's scale."""

from collections.abc import Sequence

from asysplat.report.filled import LIMITS, Costs, FilledRow, check, cost_errors, fits
from asysplat.report.sheet import Cell, Grid, Heading

# Key in `Costs`: title, what its unit is worth, format.
PRINTED = {
    "parameters": ("Param (M)", 1e6, "{:.4g}"),
    "gflops": ("GFLOPs", 1, "{:,.0f}"),
    "gaussians": ("Gaussians (M)", 1e6, "{:.3g}"),
    "gflops_true": ("True GFLOPs", 1, "{:,.0f}"),
    "geometry_share": ("Geometry (%)", 0.01, "{:.1f}"),
    "activation_gb": ("Activation (GB)", 1, "{:.3g}"),
}
CAPTION = (
    "Costs at the paper's scale. GFLOPs are those of linear and convolution modules, as the paper "
    "counts them; true ones have attention and scans too. Geometry is the share of the parameters "
    "in that branch."
)
NOTHING = Cell("-", "muted")


def cost_grid(rows: Sequence[FilledRow]) -> Grid:
    """A line for each row and for each other reading of it."""
    parts = {key: _parts(key, rows) for key in PRINTED}
    headings = [Heading("Row")]
    headings += [Heading(PRINTED[key][0], part) for key in parts for part in parts[key]]
    headings += [Heading("Check")]
    lines = []
    for row in rows:
        lines.append(_line(Cell(row.name), row, row.costs, parts, check(row)))
        for reading, costs in zip(row.row.readings, row.reading_costs, strict=False):
            name = Cell(f"or: {reading.name}", "muted")
            verdict = "fits" if fits(row.row, costs) else "no fit"
            lines.append(_line(name, row, costs, parts, verdict))
    return Grid(CAPTION, tuple(headings), tuple(lines))


def _parts(key: str, rows: Sequence[FilledRow]) -> tuple[str, ...]:
    """The columns of one cost: what the paper never prints in this table has one only."""
    if not any(key in row.row.paper for row in rows):
        return ("",)
    return ("paper", "ours") if key == "gaussians" else ("paper", "ours", "error")


def _line(
    name: Cell,
    row: FilledRow,
    costs: Costs | None,
    parts: dict[str, tuple[str, ...]],
    verdict: str,
) -> tuple[Cell, ...]:
    cells = [name]
    for key in PRINTED:
        paper = _number(key, row.row.paper)
        ours = _number(key, costs or {})
        by_part = {"paper": paper, "ours": ours, "": ours, "error": _error(key, row, costs)}
        cells += [by_part[part] for part in parts[key]]
    look = {"off": "alarm", "fits": ""}.get(verdict, "muted")
    return (*cells, Cell(verdict, look))


def _number(key: str, numbers: Costs) -> Cell:
    if key not in numbers:
        return NOTHING
    _, unit, form = PRINTED[key]
    return Cell(form.format(numbers[key] / unit))


def _error(key: str, row: FilledRow, costs: Costs | None) -> Cell:
    error = cost_errors(row.row, costs).get(key) if costs else None
    if error is None:
        return NOTHING
    return Cell(f"{error:+.1%}", "alarm" if abs(error) > LIMITS[key] else "")
