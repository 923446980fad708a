"""Filled tables on the terminal."""

from collections.abc import Sequence

from rich.box import ROUNDED
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.report.cells import make_overview, make_sheet
from asysplat.report.filled import FilledTable
from asysplat.report.sheet import Cell, Grid, Heading, Note

STYLES = {"": "", "best": "bold green", "muted": "dim", "alarm": "bold red"}
# What rich puts around the text of a column: a space on either side, and a line.
BORDER = 3


def render_terminal(tables: Sequence[FilledTable], console: Console) -> None:
    """Print the tables one after the other, the overview last, where it is seen."""
    for sheet in map(make_sheet, tables):
        console.print(Text(sheet.title, style="bold underline"))
        _print_notes(sheet.above, console)
        for grid in sheet.grids:
            _print_grid(grid, console)
        _print_notes(sheet.notes, console)
        console.print()
    if len(tables) > 1:
        _print_grid(make_overview(tables), console)


def _print_notes(notes: Sequence[Note], console: Console) -> None:
    for note in notes:
        console.print(Text.assemble((f"{note.label}: ", "bold"), note.text))


def _print_grid(grid: Grid, console: Console) -> None:
    """Print a grid; one wider than the console goes on below, with the names of its rows again."""
    console.print(Text(grid.caption, style="italic"))
    # Names wrap; what is measured of a row never does.
    widths = [_width(grid, number) for number in range(len(grid.headings))]
    widths[0] = min(widths[0], console.width // 3)
    for columns in _blocks(grid, widths, console.width):
        table = Table(box=ROUNDED)
        table.add_column(Text("\n".join(_title(grid.headings[0]))), width=widths[0])
        for number in columns:
            title = Text("\n".join(_title(grid.headings[number])))
            table.add_column(title, justify="right", no_wrap=True)
        for row in grid.rows:
            table.add_row(*(_text(row[number]) for number in (0, *columns)))
        console.print(table)


def _blocks(grid: Grid, widths: list[int], total: int) -> list[list[int]]:
    """Split the columns besides the names into blocks; those of one title stay together."""
    blocks: list[list[int]] = [[]]
    for _, columns in grid.groups()[1:]:
        shown = [0, *blocks[-1], *columns]
        if blocks[-1] and 1 + sum(BORDER + widths[number] for number in shown) > total:
            blocks.append([])
        blocks[-1] += columns
    return blocks


def _width(grid: Grid, number: int) -> int:
    texts = [*_title(grid.headings[number]), *(row[number].text for row in grid.rows)]
    return max(map(cell_len, texts))


def _title(heading: Heading) -> list[str]:
    """Split a heading into a line for each word."""
    return [word for word in (*heading.title.split(" "), heading.part) if word]


def _text(cell: Cell) -> Text:
    return Text(cell.text, style=STYLES[cell.look])
