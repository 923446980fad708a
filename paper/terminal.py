"""Print filled tables on the terminal."""

from collections.abc import Sequence

from rich.box import ROUNDED
from rich.console import Console
from rich.text import Text

from asysplat.terminal import print_table
from paper.cells import make_overview, make_section
from paper.grid import Grid, Note
from paper.tables import PaperTable

STYLES = {"": "", "best": "bold green", "muted": "dim", "alarm": "bold red"}


def render_terminal(tables: Sequence[PaperTable], console: Console) -> None:
    """Print the tables one after the other, and the overview last."""
    for section in map(make_section, tables):
        console.print(Text(section.title, style="bold underline"))
        _print_notes(section.above, console)
        for grid in section.grids:
            print_grid(grid, console)
        _print_notes(section.notes, console)
        console.print()
    if len(tables) > 1:
        print_grid(make_overview(tables), console)


def _print_notes(notes: Sequence[Note], console: Console) -> None:
    for note in notes:
        fold = f", {note.fold} (in the page)" if note.more else ""
        console.print(Text.assemble((f"{note.label}: ", "bold"), note.text, fold))


def print_grid(grid: Grid, console: Console) -> None:
    """Print a grid, its caption above; our numbers stay beside the paper's."""
    console.print(Text(grid.caption, style="italic"))
    words = [(*heading.title.split(" "), heading.part) for heading in grid.headings]  # a line each
    headings = [Text("\n".join(filter(None, lines))) for lines in words]
    rows = [[Text(cell.text, style=STYLES[cell.style]) for cell in row] for row in grid.rows]
    beside = ("ours", "error")
    first = [n for n, heading in enumerate(grid.headings) if n and heading.part not in beside]
    print_table(console, headings, rows, box=ROUNDED, first=first)
