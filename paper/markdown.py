"""Write filled tables as GitHub Markdown."""

import re
from collections.abc import Sequence

from paper.cells import INTRODUCTION, TITLE, make_overview, make_section
from paper.grid import Cell, Grid, Note
from paper.tables import PaperTable


def render_markdown(tables: Sequence[PaperTable]) -> str:
    """Write the page: an introduction, an overview, and a section for each table."""
    parts = [f"# {TITLE}", escape(INTRODUCTION)]
    if len(tables) > 1:
        parts.append(_grid(make_overview(tables)))
    for section in map(make_section, tables):
        grids = map(_grid, section.grids)
        parts += [f"## {escape(section.title)}", _notes(section.above), *grids]
        parts.append(_notes(section.notes))
    return "\n\n".join(parts) + "\n"


def escape(text: str) -> str:
    """Escape Markdown's special characters."""
    return re.sub(r"([\\`*_|<>#~\[\]])", r"\\\1", text)


def _grid(grid: Grid) -> str:
    titles = [escape(" ".join(filter(None, heading))) for heading in grid.headings]
    rule = [":--", *["--:"] * (len(titles) - 1)]
    lines = [titles, rule, *([_cell(cell) for cell in row] for row in grid.rows)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{escape(grid.caption)}\n\n{table}"


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    if cell.link:
        return f"[{text}](#{cell.link})"
    return f"**{text}**" if cell.style in ("best", "alarm") else text


def _notes(notes: Sequence[Note]) -> str:
    texts = [f"`{note.text}`" if note.code else escape(note.text) for note in notes]
    folds = [_fold(note) for note in notes]
    lines = zip(notes, texts, folds, strict=True)
    return "\n".join(f"- **{escape(note.label)}**: {text}{fold}" for note, text, fold in lines)


def _fold(note: Note) -> str:
    if not note.more:
        return ""
    text = escape(", ".join(note.more))
    return f" <details><summary>{note.fold}</summary> {text}</details>"
