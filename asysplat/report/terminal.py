"""Print filled tables on the terminal."""

from collections.abc import Sequence

from rich.box import ROUNDED
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.report.cells import make_overview, make_section
from asysplat.report.fill import FilledTable
from asysplat.report.table import Grid, Heading, Note

STYLES = {"": "", "best": "bold green", "muted": "dim", "alarm": "bold red"}
BORDER = 3  # rich surrounds the text of a column with two spaces and a line


def render_terminal(tables: Sequence[FilledTable], console: Console) -> None:
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
    """Print a grid; one wider than the console continues below, with its row names again."""
    console.print(Text(grid.caption, style="italic"))
    titles = [_title(heading) for heading in grid.headings]
    texts = [title.split("\n") for title in titles]
    for row in grid.rows:
        texts = [[*column, cell.text] for column, cell in zip(texts, row, strict=True)]
    # Row names wrap, numbers never do.
    widths = [max(map(cell_len, column)) for column in texts]
    widths[0] = min(widths[0], console.width // 3)
    for columns in _blocks(grid, widths, console.width):
        table = Table(box=ROUNDED)
        table.add_column(Text(titles[0]), width=widths[0])
        for number in columns:
            table.add_column(Text(titles[number]), justify="right", no_wrap=True)
        for row in grid.rows:
            cells = (row[number] for number in (0, *columns))
            table.add_row(*(Text(cell.text, style=STYLES[cell.style]) for cell in cells))
        console.print(table)


def _blocks(grid: Grid, widths: list[int], total: int) -> list[list[int]]:
    """Split the columns after the names into blocks; those of one title stay together."""
    blocks: list[list[int]] = [[]]
    for _, columns in grid.groups()[1:]:
        block = [0, *blocks[-1], *columns]
        if blocks[-1] and 1 + sum(BORDER + widths[number] for number in block) > total:
            blocks.append([])
        blocks[-1] += columns
    return blocks


def _title(heading: Heading) -> str:
    """Write a heading with a line for each word."""
    return "\n".join(word for word in (*heading.title.split(" "), heading.part) if word)
