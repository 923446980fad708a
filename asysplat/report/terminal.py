"""Print filled tables on the terminal."""

from collections.abc import Sequence

from rich.box import ROUNDED
from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.report.cells import make_overview, make_section
from asysplat.report.paper import PaperTable
from asysplat.report.table import Grid, Note

STYLES = {"": "", "best": "bold green", "muted": "dim", "alarm": "bold red"}


def render_terminal(tables: Sequence[PaperTable], console: Console) -> None:
    """Print the tables one after the other, and the overview last."""
    for section in map(make_section, tables):
        console.print(Text(section.title, style="bold underline"))
        _print_notes(section.above, console)
        for grid in section.grids:
            _print_grid(grid, console)
        _print_notes(section.notes, console)
        console.print()
    if len(tables) > 1:
        _print_grid(make_overview(tables), console)


def _print_notes(notes: Sequence[Note], console: Console) -> None:
    for note in notes:
        console.print(Text.assemble((f"{note.label}: ", "bold"), note.text))


def _print_grid(grid: Grid, console: Console) -> None:
    console.print(Text(grid.caption, style="italic"))
    table = Table(box=ROUNDED)
    for number, heading in enumerate(grid.headings):
        words = (*heading.title.split(" "), heading.part)  # a line each
        title = Text("\n".join(filter(None, words)))
        table.add_column(title, justify="right" if number else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*(Text(cell.text, style=STYLES[cell.style]) for cell in row))
    console.print(table)
