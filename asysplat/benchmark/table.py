"""How a suite's numbers are shown on the terminal."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.box import ROUNDED
from rich.table import Table
from rich.text import Text

NOTHING = "-"
Columns = Mapping[str, Callable[[Any], str | Text]]


def make_table(
    title: str, columns: Columns, rows: Sequence[Any], notes: str | None = None, names: int = 1
) -> Table:
    """A column for each function of a row, under its heading; the first `names` hold words."""
    table = Table(title=title, caption=notes, box=ROUNDED)
    for number, heading in enumerate(columns):
        table.add_column(heading, justify="left" if number < names else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(show(row) for show in columns.values()))
    return table


def show(value: float | None, pattern: str) -> str:
    """A dash for what was not measured."""
    return NOTHING if value is None else pattern.format(value)


def show_limited(value: float | None, limit: float) -> str | Text:
    """Red above the limit."""
    if value is None:
        return NOTHING
    return Text(f"{value:.2f}", style="bold red" if value > limit else "")


def milliseconds(seconds: Mapping[str, float] | None) -> str:
    """Median and interquartile range."""
    if seconds is None:
        return NOTHING
    return f"{1000 * seconds['median']:.1f} ± {1000 * seconds['iqr']:.1f}"


def describe_machine_in_words(machine: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in machine.items())
