"""What a reader sees of a table, before it is known where: cells of text, and notes."""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """Text; `look` is best, muted, alarm or nothing; `link` the anchor of another part."""

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
        """Neighbouring columns under one title: the title and their numbers."""
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
    """As GitHub makes it from a heading, so that one link serves Markdown and HTML."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
