"""The tables of all suites, and the files that they are written to.

A column is a heading and a function that writes its cells.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.box import ROUNDED
from rich.table import Table

from asysplat.files import atomic_write
from asysplat.report.markdown import escape
from benchmarks.timing import BUSY, Result

NOTHING = "-"  # for what was not measured
WIDTH = 100  # characters of a line of JSON, above which a dictionary or list is split
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


def median_iqr_column(path: str, pattern: str = "{:.1f}", unit: float = 1e-3) -> Write:
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


def dumps(value: Any, indent: str = "") -> str:
    """Write JSON with each row of a list, and each dictionary of plain values, on one line.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    line = json.dumps(value, allow_nan=False)
    items = value.values() if isinstance(value, dict) else value
    if len(line) <= WIDTH or not any(isinstance(item, dict | list) for item in items):
        return line
    if isinstance(value, list):
        rows = [f"{indent} {json.dumps(row)}" for row in value]
        return "\n".join(["[", ",\n".join(rows), f"{indent}]"])
    rows = [f"{indent} {json.dumps(k)}: {dumps(v, indent + ' ')}" for k, v in value.items()]
    return "\n".join(["{", ",\n".join(rows), f"{indent}}}"])


def write_results(
    results: Result, tables: Sequence[Table], figure: Figure | None, path: Path
) -> list[Path]:
    """Write <path>.json, <path>.md and, of a figure, <path>.png; return their paths.

    Raises:
        InputError: a file cannot be written.
        ValueError: a result is NaN or infinite.
    """
    texts = {".json": dumps(results) + "\n", ".md": "\n".join(map(markdown, tables))}
    path.parent.mkdir(parents=True, exist_ok=True)
    for suffix, content in texts.items():
        with atomic_write(path.with_suffix(suffix)) as partial:
            partial.write_text(content)
    if figure is not None:
        with atomic_write(path.with_suffix(".png")) as partial:
            figure.savefig(partial, dpi=150)
    return [path.with_suffix(s) for s in (*texts, ".png") if s in texts or figure is not None]
