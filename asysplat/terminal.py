"""The terminal: names as they are, and tables of all their columns."""

from collections.abc import Collection, Sequence

from rich.box import HEAVY_HEAD, Box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

NAMES_FRACTION = 1 / 3  # greatest fraction of the terminal's width for the names of the rows
UNLIMITED = 10_000  # characters


def make_console(stderr: bool = False) -> Console:
    """Make a console that prints names as they are: "[b]" or ":x:" in a file name is no markup."""
    return Console(stderr=stderr, markup=False, emoji=False)


def print_table(
    console: Console,
    headings: Sequence[str | Text],
    rows: Sequence[Sequence[str | Text]],
    title: str | None = None,
    box: Box = HEAVY_HEAD,
    first: Collection[int] = (),
) -> None:
    """Print a table; columns that do not fit follow in tables below, each with the first one."""

    def part(numbers: Sequence[int]) -> Table:
        table = Table(box=box, title=title if numbers[1] == 1 else None)
        for number in numbers:
            options = {"justify": "right"} if number else {"max_width": names_width}
            table.add_column(headings[number], overflow="fold", **options)
        for row in rows:
            table.add_row(*(row[number] for number in numbers))
        return table

    def width(numbers: Sequence[int]) -> int:
        options = console.options.update(max_width=UNLIMITED)
        return Measurement.get(console, options, part(numbers)).maximum

    names_width = int(NAMES_FRACTION * console.width)
    starts = sorted(first or range(1, len(headings)))
    numbers = [0]
    for start, end in zip(starts, [*starts[1:], len(headings)], strict=True):
        together = range(start, end)
        if len(numbers) > 1 and width([*numbers, *together]) > console.width:
            console.print(part(numbers))
            numbers = [0]
        numbers += together
    console.print(part(numbers))
