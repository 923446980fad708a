"""The one model of a printed table, for all writers: grids of cells, and notes."""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """A text; `look` is best, muted, alarm or nothing; `link` the anchor of another part."""

    text: str
    look: str = ""
    link: str = ""


@dataclass(frozen=True)
class Heading:
    """A column's title, and which part of it ("paper", "ours") where it has several."""

    title: str
    part: str = ""


@dataclass(frozen=True)
class Grid:
    """A table of cells; the first column names the row."""

    caption: str
    headings: tuple[Heading, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def groups(self) -> list[tuple[str, list[int]]]:
        """Group neighboring columns by title: each title and the numbers of its columns."""
        found: list[tuple[str, list[int]]] = []
        for number, heading in enumerate(self.headings):
            if heading.part and found and found[-1][0] == heading.title:
                found[-1][1].append(number)
            else:
                found.append((heading.title, [number]))
        return found


@dataclass(frozen=True)
class Note:
    """A line above or under a table; `code` is set in type-writer."""

    label: str
    text: str
    code: bool = False


@dataclass(frozen=True)
class Sheet:
    """One table of the report."""

    title: str
    above: tuple[Note, ...]
    grids: tuple[Grid, ...]
    notes: tuple[Note, ...]

    @property
    def anchor(self) -> str:
        return anchor(self.title)


def anchor(title: str) -> str:
    """Make the anchor that GitHub gives a heading, so that a link serves Markdown and HTML."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
