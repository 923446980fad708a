"""Turn filled tables into cells: measured numbers, costs, the overview of all tables."""

from collections.abc import Sequence

from paper.compare import (
    LIMITS,
    check_costs,
    claim_value,
    cost_errors,
    fits,
    mean_and_std,
    paired_difference,
)
from paper.fill import COMPUTED
from paper.grid import Cell, Grid, Heading, Section, anchor
from paper.notes import notes, protocol_notes, rho_text
from paper.tables import Claim, Column, Costs, Number, PaperRow, PaperTable

TITLE = "AsySplat: our numbers beside the paper's"
INTRODUCTION = (
    "Each column of the paper stands beside ours: measured at our scale, on the test set that its "
    "heading names, so compare the order of the rows and not the numbers. Bold is the best of its "
    "column. † marks a row whose layout the paper leaves open."
)
OVERVIEW = (
    "All tables. Rank agreement is Spearman's rho with the paper's order; ? where rows differ "
    "hardly more than seeds alone make them, or there is one seed."
)
ARROWS = {"higher": "\u00a0↑", "lower": "\u00a0↓", None: ""}  # after a space that does not break
# Key in `Costs`: title, unit, format.
COSTS = {
    "parameters": ("Param (M)", 1e6, "{:.4g}"),
    "gflops": ("Module GFLOPs", 1, "{:,.0f}"),
    "gflops_true": ("True GFLOPs", 1, "{:,.0f}"),
    "gaussians": ("Gaussians (M)", 1e6, "{:.3g}"),
    "geometry_ratio": ("Geometry (%)", 0.01, "{:.1f}"),
    "activation_gb": ("Activation (GB)", 1, "{:.3g}"),
}
COST_CAPTION = (
    "Costs at the paper's scale. Module GFLOPs are those of linear and convolution modules, as the "
    "paper counts them; true ones have attention products, scans and depthwise convolutions too. "
    "Geometry is the share of the parameters in that branch."
)
CLAIM_FORMS = {
    "reduction": "{:.1%}",
    "speedup": "{:,.0f}x",
    "gain": "{:+.2f}",
    "total": "{:.3g} h",
}
CLAIM_CAPTION = (
    "Paper: computed from the numbers that its tables print. Ours: from those of AsySplat and of "
    "what it is compared with; hours are summed over the stages."
)
DIFFERENCE_CAPTION = (
    "Differences to {base}, paired by seed: mean ± half of the 95 % confidence interval (Student's "
    "t). Bold where the interval does not contain 0: seeds alone hardly make such a difference."
)
NOTHING = Cell("-", "muted")


def make_section(filled: PaperTable) -> Section:
    """Build everything that is printed of one table."""
    grids = [_measured_grid(filled)] if filled.rows else [_claim_grid(filled.claims)]
    if differences := _difference_grid(filled):
        grids.append(differences)
    if any(row.costs for row in filled.rows):
        grids.append(_cost_grid(_networks(filled)))
    title, above = filled.heading, protocol_notes(filled)
    return Section(title, anchor(title), above, grids, notes(filled))


def make_overview(tables: Sequence[PaperTable]) -> Grid:
    """Build a line for each table: the rows that ran, and their agreement with the paper."""
    titles = ("Table", "Rows run", "Seeds", "Rank agreement", "Costs that fit")
    lines = [_overview_line(filled) for filled in tables if filled.rows]
    return Grid(OVERVIEW, list(map(Heading, titles)), lines)


def _networks(filled: PaperTable) -> list[PaperRow]:
    return [row for row in filled.rows if not row.post_optimization]


def _overview_line(filled: PaperTable) -> list[Cell]:
    ours = [row for row in filled.rows if not row.quoted]
    run = sum(bool(row.seeds) for row in ours)
    counts = sorted({len(row.seeds) for row in ours if row.seeds})  # seeds of the rows that ran
    seeds = " to ".join(dict.fromkeys(str(count) for count in (*counts[:1], *counts[-1:])))
    checks = [check_costs(row) for row in _networks(filled)]
    verified = [check for check in checks if check in ("fits", "off")]
    unverified = sum(check.startswith("unverified") for check in checks)
    fitting = f"{verified.count('fits')} of {len(verified)}"
    fitting += f", {unverified} †" * bool(unverified)
    return [
        Cell(filled.heading, link=anchor(filled.heading)),
        Cell(f"{run} of {len(ours)}", "" if run else "muted"),
        Cell(seeds) if counts else NOTHING,
        Cell(rho_text(filled)),
        Cell(fitting, "alarm" * ("off" in verified)) if verified else NOTHING,
    ]


def _measured_grid(filled: PaperTable) -> Grid:
    headings = [Heading("Row")]
    columns = [[Cell(row.label) for row in filled.rows]]
    for column in filled.columns:
        if column.key in COMPUTED:
            continue
        arrow = ARROWS[column.better]
        if filled.number is not None:
            headings.append(Heading(column.title() + arrow, "paper"))
            numbers = [row.numbers.get(column.key) for row in filled.rows]
            if any(column.key in row.bounds for row in filled.rows):
                numbers = [None] * len(numbers)  # none is the best
            texts = [row.text(column) for row in filled.rows]
            columns.append(_cells(texts, numbers, column, ["-"] * len(texts)))
        headings.append(Heading(filled.our_title(column) + arrow, "ours"))
        values = [row.values.get(column.key) for row in filled.rows]
        means = [mean_and_std(own)[0] if own else None for own in values]
        texts = [_mean_text(own, column) if own else "" for own in values]
        missing = ["quoted" if row.quoted else "not run" for row in filled.rows]
        columns.append(_cells(texts, means, column, missing))
    return Grid("Measured", headings, list(map(list, zip(*columns, strict=True))))


def _difference_grid(filled: PaperTable) -> Grid | None:
    """Build a line for each row beside the base: its differences; None without such rows."""
    base = next((row for row in filled.rows if row.name == filled.base), None)
    if base is None or len(base.seeds) < 2:
        return None
    columns = [column for column in filled.columns if column.better and column.test_set]
    lines = []
    for row in filled.rows:
        if row is base or not row.seeds:
            continue
        cells = [_difference_cell(paired_difference(row, base, c.key), c) for c in columns]
        lines.append([Cell(row.label), *cells])
    headings = [Heading(filled.our_title(c) + ARROWS[c.better]) for c in columns]
    caption = DIFFERENCE_CAPTION.format(base=base.label)
    return Grid(caption, [Heading("Row"), *headings], lines) if lines else None


def _difference_cell(difference: tuple[float, float | None] | None, column: Column) -> Cell:
    if difference is None:
        return NOTHING
    mean, half = difference
    text = f"{'+' if mean >= 0 else '-'}{column.text(abs(mean))}"
    if half is None:
        return Cell(text, "muted")
    decimals = len(text.partition(".")[2])
    text = f"{text} ± {half / column.unit:.{decimals}f}"
    return Cell(text, "best" if abs(mean) > half else "")


def _claim_grid(claims: Sequence[Claim]) -> Grid:
    """Build a line for each claim: from the paper's tables, from our numbers, and those."""
    titles = (("Claim", ""), ("Number", "paper"), ("Number", "ours"), ("Computed from", "ours"))
    lines = []
    for claim in claims:
        paper = claim_value(claim, lambda row, key=claim.column.key: _least(row, key))
        bounded = any(claim.column.key in row.bounds for side in claim.rows for row in side)
        ours = claim_value(claim, lambda row, key=claim.column.key: _our_number(row, key))
        missing = "not counted" if claim.column.key in COMPUTED else "not measured"
        sides = [_our_side(side, claim.column) for side in claim.rows]
        numbers = f": {' / '.join(side or missing for side in sides)}" * any(sides)
        form = CLAIM_FORMS[claim.form]
        lines.append(
            [
                Cell(claim.text) if claim.stated else Cell(f"ours: {claim.text}", "muted"),
                NOTHING if paper is None else Cell("over " * bounded + form.format(paper)),
                Cell(missing, "muted") if ours is None else Cell(form.format(ours)),
                Cell(claim.column.kind + numbers, "muted" * (ours is None)),
            ]
        )
    return Grid(CLAIM_CAPTION, [Heading(*title) for title in titles], lines)


def _least(row: PaperRow, key: str) -> Number | None:
    return float(row.bounds[key][1:]) if key in row.bounds else row.numbers.get(key)


def _our_number(row: PaperRow, key: str) -> Number | None:
    """Return our count of a row or the mean of its seeds; None without."""
    if key in COMPUTED:
        return (row.costs or {}).get(key)
    return mean_and_std(row.values[key])[0] if row.values.get(key) else None


def _our_side(rows: Sequence[PaperRow], column: Column) -> str:
    """Format the sum of our numbers of a claim's rows; "" where one is missing."""
    numbers = [_our_number(row, column.key) for row in rows]
    return "" if None in numbers else column.text(float(sum(numbers)))


def _cells(
    texts: Sequence[str], numbers: Sequence[Number | None], column: Column, missing: Sequence[str]
) -> list[Cell]:
    """Make the cells of a column: texts, the best of them bold, or what is written for none."""
    rows = zip(texts, _best(numbers, column), missing, strict=True)
    return [
        Cell(text, "best" * best) if text else Cell(other, "muted") for text, best, other in rows
    ]


def _mean_text(values: Sequence[Number], column: Column) -> str:
    """Format mean ± std, with as many decimals as the column's numbers."""
    mean, std = mean_and_std(values)
    text = column.text(mean)
    if std is None:
        return text
    decimals = len(text.partition(".")[2])
    return f"{text} ± {std / column.unit:.{decimals}f}"


def _best(numbers: Sequence[Number | None], column: Column) -> list[bool]:
    """Find the numbers that print like the best one; none if all print alike."""
    texts = [None if number is None else column.text(float(number)) for number in numbers]
    present = [float(number) for number in numbers if number is not None]
    if column.better is None or len(set(texts) - {None}) < 2:
        return [False] * len(numbers)
    best = column.text(max(present) if column.better == "higher" else min(present))
    return [text == best for text in texts]


def _cost_grid(rows: Sequence[PaperRow]) -> Grid:
    """Build a line for each row and for each other reading of it."""
    in_paper = {key for row in rows for key in row.numbers}
    columns = []  # key in COSTS, part: a cost that the paper never prints in this table has one
    for key in COSTS:
        parts = ("paper", "ours", "error") if key in LIMITS else ("paper", "ours")
        columns += [(key, part) for part in (parts if key in in_paper else ("",))]

    def line(name: Cell, row: PaperRow, costs: Costs | None, check: str) -> list[Cell]:
        errors = cost_errors(row, costs) if costs else {}
        cells = [name]
        for key, part in columns:
            numbers = {"paper": row.numbers, "error": errors}.get(part, costs or {})
            if key not in numbers:
                cells.append(NOTHING)
            elif part == "error":
                wrong = abs(errors[key]) > LIMITS[key]
                cells.append(Cell(f"{errors[key]:+.1%}", "alarm" * wrong))
            else:
                _, unit, form = COSTS[key]
                cells.append(Cell(form.format(numbers[key] / unit)))
        return [*cells, Cell(check, {"off": "alarm", "fits": ""}.get(check, "muted"))]

    lines = []
    for row in rows:
        lines.append(line(Cell(row.label), row, row.costs, check_costs(row)))
        for reading, costs in zip(row.readings, row.reading_costs, strict=False):
            check = "fits" if fits(row, costs) else "no fit"
            lines.append(line(Cell(f"or: {reading}", "muted"), row, costs, check))
    headings = [Heading(COSTS[key][0], part) for key, part in columns]
    return Grid(COST_CAPTION, [Heading("Row"), *headings, Heading("Check")], lines)
