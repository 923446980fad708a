"""Filled tables as GitHub Markdown."""

import re
from collections.abc import Sequence

from asysplat.report.cells import INTRODUCTION, TITLE, make_overview, make_sheet
from asysplat.report.filled import FilledTable
from asysplat.report.sheet import Cell, Grid, Heading, Note


def render_markdown(tables: Sequence[FilledTable]) -> str:
    """Write the page: an introduction, an overview, and a section for each table."""
    parts = [f"# {TITLE}", escape(INTRODUCTION)]
    if len(tables) > 1:
        parts.append(_grid(make_overview(tables)))
    for sheet in map(make_sheet, tables):
        parts.append(f"## {escape(sheet.title)}")
        parts.append("\n".join(map(_note, sheet.above)))
        parts += map(_grid, sheet.grids)
        parts.append("\n".join(map(_note, sheet.notes)))
    return "\n\n".join(parts) + "\n"


def escape(text: str) -> str:
    """Escape what Markdown would interpret."""
    return re.sub(r"([\\`*_|<>#~\[\]])", r"\\\1", text)


def _grid(grid: Grid) -> str:
    rule = [":--", *["--:"] * (len(grid.headings) - 1)]
    lines = [[_heading(heading) for heading in grid.headings], rule]
    lines += [[_cell(cell) for cell in row] for row in grid.rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{escape(grid.caption)}\n\n{table}"


def _heading(heading: Heading) -> str:
    return escape(" ".join(filter(None, (heading.title, heading.part))))


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    if cell.link:
        return f"[{text}](#{cell.link})"
    return f"**{text}**" if cell.look in ("best", "alarm") else text


def _note(note: Note) -> str:
    text = f"`{note.text}`" if note.code else escape(note.text)
    return f"- **{escape(note.label)}**: {text}"
