"""The template data of a table's section: grids of cells and notes, the same for all renderers."""

import re
from itertools import groupby
from typing import NamedTuple


class Cell(NamedTuple):
    """A text; `style` is best, muted, alarm or ""; `link` is the anchor of a section."""

    text: str
    style: str = ""
    link: str = ""


class Heading(NamedTuple):
    """A column's title, and the part of it, "paper", "ours" or "error", if it has several."""

    title: str
    part: str = ""


class Grid(NamedTuple):
    """A table of cells; the first column names the row."""

    caption: str
    headings: list[Heading]
    rows: list[list[Cell]]

    def groups(self) -> list[tuple[str, list[int]]]:
        """Group neighboring columns by title: each title and the numbers of its columns."""
        # A column without parts is a group of its own.
        keys = [(h.title, -1 if h.part else i) for i, h in enumerate(self.headings)]
        groups = groupby(range(len(keys)), keys.__getitem__)
        return [(key[0], list(numbers)) for key, numbers in groups]


class Note(NamedTuple):
    """A line above or below a table; `code` is set in typewriter, `more` is folded away."""

    label: str
    text: str
    code: bool = False
    more: tuple[str, ...] = ()

    @property
    def fold(self) -> str:
        """What stands for `more`; "" without."""
        return f"and {len(self.more)} more" if self.more else ""


class Section(NamedTuple):
    """One table of the report."""

    title: str
    anchor: str
    above: list[Note]
    grids: list[Grid]
    notes: list[Note]


def anchor(title: str) -> str:
    """Return the anchor that GitHub gives a heading, so that a link works in Markdown and HTML."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
