"""Filled tables on the terminal."""

from collections.abc import Sequence

from rich.box import ROUNDED
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.report.filled import FilledTable
from asysplat.report.layout import make_overview, make_sheet
from asysplat.report.sheet import Cell, Grid, Heading

STYLES = {"": "", "best": "bold green", "muted": "dim", "alarm": "bold red"}
# What rich puts around the text of a column: a space on either side, and a line.
BORDER = 3


def render_terminal(tables: Sequence[FilledTable], console: Console) -> None:
    """The tables one after the other, the overview last, where it is seen."""
    for sheet in map(make_sheet, tables):
        console.print(Text(sheet.title, style="bold underline"))
        for grid in sheet.grids:
            _print_grid(grid, console)
        for note in sheet.notes:
            console.print(Text.assemble((f"{note.label}: ", "bold"), note.text))
        console.print()
    if len(tables) > 1:
        _print_grid(make_overview(tables), console)


def _print_grid(grid: Grid, console: Console) -> None:
    """A grid wider than the console goes on below, with the names of its rows again."""
    console.print(Text(grid.caption, style="italic"))
    for columns in _blocks(grid, console.width):
        table = Table(box=ROUNDED)
        for number in columns:
            title = "\n".join(_title(grid.headings[number]))
            table.add_column(Text(title), justify="right" if number else "left", no_wrap=True)
        for row in grid.rows:
            table.add_row(*(_text(row[number]) for number in columns))
        console.print(table)


def _blocks(grid: Grid, width: int) -> list[list[int]]:
    """Column numbers of each block: what stands under one title is kept together."""
    names, *groups = [columns for _, columns in grid.groups()]
    blocks = [[*names]]
    for columns in groups:
        if len(blocks[-1]) > 1 and _width(grid, blocks[-1] + columns) > width:
            blocks.append([*names])
        blocks[-1] += columns
    return blocks


def _width(grid: Grid, columns: list[int]) -> int:
    return 1 + sum(BORDER + _column_width(grid, number) for number in columns)


def _column_width(grid: Grid, number: int) -> int:
    texts = [*_title(grid.headings[number]), *(row[number].text for row in grid.rows)]
    return max(map(cell_len, texts))


def _title(heading: Heading) -> list[str]:
    """A line for each word."""
    return [*heading.title.split(" "), heading.part]


def _text(cell: Cell) -> Text:
    return Text(cell.text, style=STYLES[cell.look])
