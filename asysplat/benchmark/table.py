"""The tables of all suites: a column is a heading and a function that writes its cells."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.box import ROUNDED
from rich.table import Table

from asysplat.benchmark.timing import BUSY, Result
from asysplat.report.markdown import escape

NOTHING = "-"  # for what was not measured
Write = Callable[[Result], str]
Columns = Mapping[str, Write]


def make_table(
    title: str, columns: Columns, rows: Sequence[Result], notes: str | None = None, names: int = 1
) -> Table:
    """Make a table with a line for each row; the first `names` columns hold words."""
    table = Table(title=title, caption=notes, box=ROUNDED)
    for number, heading in enumerate(columns):
        table.add_column(heading, justify="left" if number < names else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(write(row) for write in columns.values()))
    return table


def machine_note(results: Result) -> str:
    """Write the note that every suite begins with: the machine, and the meaning of ±."""
    machine = ", ".join(f"{key} {value}" for key, value in results["machine"].items())
    return f"{machine}\nmedian ± interquartile range; busy: that is over {BUSY:.0%} of the median"


def markdown(table: Table) -> str:
    """Write a table as GitHub Markdown, its title above and its notes below."""
    headings = [" ".join(str(column.header).split()) for column in table.columns]
    rules = [":--" if column.justify == "left" else "--:" for column in table.columns]
    cells = [list(map(str, column.cells)) for column in table.columns]
    rows = [[escape(cell) for cell in row] for row in (headings, *zip(*cells, strict=True))]
    lines = [f"| {' | '.join(row)} |" for row in (rows[0], rules, *rows[1:])]
    notes = [f"- {escape(line)}" for line in str(table.caption or "").splitlines()]
    return "\n".join([f"## {escape(str(table.title))}", "", *lines, "", *notes]) + "\n"


def at(row: Result, path: str) -> Any:
    """Return row["a"]["b"] for the path "a.b"; None where there is no such value."""
    for key in path.split("."):
        row = row.get(key) if row else None
    return row


def worst(row: Result, path: str) -> float:
    """Return the number at a path; of several numbers, the largest."""
    value = at(row, path)
    return max(value.values()) if isinstance(value, Mapping) else value


def text(pattern: str) -> Write:
    """Write the values that a pattern such as "{views} views" names."""
    return lambda row: pattern.format(**row)


def number(path: str, pattern: str, unit: float = 1.0) -> Write:
    """Write a number, divided by its unit."""
    return lambda row: NOTHING if at(row, path) is None else pattern.format(at(row, path) / unit)


def spread(path: str, pattern: str = "{:.1f}", unit: float = 1e-3) -> Write:
    """Write median ± interquartile range, and "busy" where that is wide; seconds in ms."""

    def write(row: Result) -> str:
        if (value := at(row, path)) is None:
            return NOTHING
        words = " ± ".join(pattern.format(value[name] / unit) for name in ("median", "iqr"))
        return f"{words} busy" if value["iqr"] > BUSY * value["median"] else words

    return write


def error(path: str) -> Write:
    """Write an error, with a * where it was measured on a smaller case."""

    def write(row: Result) -> str:
        if row["error"] is None:
            return NOTHING
        sizes, own_sizes = row["error"]["measured_on"], row.get("sizes", row)
        smaller = any(own_sizes[key] != size for key, size in sizes.items())
        return f"{worst(row, path):.1e}{'*' if smaller else ''}"

    return write
