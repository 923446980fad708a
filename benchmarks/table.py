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
from benchmarks.timing import BUSY, Result
from paper.markdown import escape

NOT_MEASURED = "-"
WIDTH = 100  # a dictionary or list that is longer as one line of JSON is split
WriteCell = Callable[[Result], str]
Columns = Mapping[str, WriteCell]


def make_table(
    title: str, columns: Columns, rows: Sequence[Result], notes: str | None = None, names: int = 1
) -> Table:
    """Make a table with a line for each row; its first `names` columns are aligned left."""
    table = Table(title=title, caption=notes, box=ROUNDED)
    for number, heading in enumerate(columns):
        name = number < names  # only names are wrapped where the terminal is narrow
        table.add_column(heading, justify="left" if name else "right", no_wrap=not name)
    for row in rows:
        table.add_row(*(write(row) for write in columns.values()))
    return table


def machine_text(results: Result) -> str:
    """Write the machine that the results were measured on, and the versions of packages."""
    return ", ".join(f"{key} {value}" for key, value in results["machine"].items())


def machine_note(results: Result) -> str:
    """Write the first lines of every suite's notes: the machine, and the meaning of ±."""
    busy = f"busy: the range exceeds {BUSY:.0%} of the median"
    return f"{machine_text(results)}\nmedian ± interquartile range; {busy}"


def format_markdown(table: Table) -> str:
    """Write a table as GitHub Markdown, with its title above and its notes below."""
    headings = [" ".join(str(column.header).split()) for column in table.columns]
    rules = [":--" if column.justify == "left" else "--:" for column in table.columns]
    cells = [list(map(str, column.cells)) for column in table.columns]
    rows = [[escape(cell) for cell in row] for row in (headings, *zip(*cells, strict=True))]
    lines = [f"| {' | '.join(row)} |" for row in (rows[0], rules, *rows[1:])]
    notes = [f"- {escape(line)}" for line in str(table.caption or "").splitlines()]
    return "\n".join([f"## {escape(str(table.title))}", "", *lines, "", *notes]) + "\n"


def value_at(row: Result, path: str) -> Any:
    """Return row["a"]["b"] for the path "a.b", or None if there is no such value."""
    for key in path.split("."):
        row = row.get(key) if row else None
    return row


def largest_at(row: Result, path: str) -> float | int:
    """Return the number at a path, or the largest of a dictionary of numbers."""
    value = value_at(row, path)
    return max(value.values()) if isinstance(value, Mapping) else value


def text_column(pattern: str) -> WriteCell:
    """Return a function that fills a pattern such as "{views} views" with a row's values."""
    return lambda row: pattern.format(**row)


def number_column(path: str, pattern: str, unit: float = 1.0) -> WriteCell:
    """Return a function that writes the number at a path, divided by `unit`."""

    def write(row: Result) -> str:
        value = value_at(row, path)
        return NOT_MEASURED if value is None else pattern.format(value / unit)

    return write


def median_iqr_column(path: str, pattern: str = "{:.1f}", unit: float = 1e-3) -> WriteCell:
    """Return a function that writes median ± interquartile range, and "busy" where it is wide.

    Both are divided by `unit`; by default, seconds are written in milliseconds.
    """

    def write(row: Result) -> str:
        if (value := value_at(row, path)) is None:
            return NOT_MEASURED
        words = " ± ".join(pattern.format(value[name] / unit) for name in ("median", "iqr"))
        return f"{words} busy" if value["iqr"] > BUSY * value["median"] else words

    return write


def error_column(path: str) -> WriteCell:
    """Return a function that writes an error, with a * where a smaller case was measured."""

    def write(row: Result) -> str:
        if row["error"] is None:
            return NOT_MEASURED
        measured_sizes, row_sizes = row["error"]["measured_on"], row.get("sizes", row)
        smaller = any(row_sizes[key] != size for key, size in measured_sizes.items())
        return f"{largest_at(row, path):.1e}{'*' if smaller else ''}"

    return write


def format_json(value: Any, indent: str = "") -> str:
    """Write JSON in which each row of a list, and each dictionary of plain values, is one line."""
    line = json.dumps(value, allow_nan=False)
    items = value.values() if isinstance(value, dict) else value
    if len(line) <= WIDTH or not any(isinstance(item, dict | list) for item in items):
        return line
    if isinstance(value, list):
        rows = [f"{indent} {json.dumps(row)}" for row in value]
        return "\n".join(["[", ",\n".join(rows), f"{indent}]"])
    rows = [f"{indent} {json.dumps(k)}: {format_json(v, indent + ' ')}" for k, v in value.items()]
    return "\n".join(["{", ",\n".join(rows), f"{indent}}}"])


def write_results(
    results: Result, tables: Sequence[Table], figure: Figure | None, path: Path
) -> list[Path]:
    """Write <path>.json, <path>.md and, if there is a figure, <path>.png; return their paths."""
    texts = {".json": format_json(results) + "\n", ".md": "\n".join(map(format_markdown, tables))}
    path.parent.mkdir(parents=True, exist_ok=True)
    for suffix, content in texts.items():
        with atomic_write(path.with_suffix(suffix)) as partial:
            partial.write_text(content)
    if figure is not None:
        with atomic_write(path.with_suffix(".png")) as partial:
            figure.savefig(partial, dpi=150)
    return [path.with_suffix(s) for s in (*texts, ".png") if s in texts or figure is not None]
