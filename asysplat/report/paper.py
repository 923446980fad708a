"""The paper's tables as values: paper.yaml holds every number that the paper prints."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from omegaconf import OmegaConf

from asysplat.errors import InputError

PAPER = Path(__file__).with_name("paper.yaml")


@dataclass(frozen=True)
class Column:
    """One kind of number.

    Args:
        key: "parameters", "gflops", ..., or "<test set>/<metric>" such as "dl3dv/psnr".
        title: as printed.
        better: "higher" or "lower"; None where neither is.
        format: of one number, as for str.format.
    """

    key: str
    title: str
    better: str | None
    format: str


@dataclass(frozen=True)
class Reading:
    """Another layout that the paper's words allow.

    Args:
        name: what it changes.
        run: overrides of train.py that build it.
    """

    name: str
    run: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """One method of a table.

    Args:
        name: as the paper prints it.
        paper: column key -> the paper's number.
        run: overrides of train.py that give it; None for a method that is only quoted.
        views, size: input views, height and width that its costs are computed at.
        post_optimisation: steps on the predicted Gaussians; such rows need evaluate.py.
        unverified: why the layout of this row is not known to be the paper's; None where it is.
        readings: the other layouts of an unverified row.
    """

    name: str
    paper: dict[str, float]
    run: tuple[str, ...] | None
    views: int
    size: tuple[int, int]
    post_optimisation: int = 0
    unverified: str | None = None
    readings: tuple[Reading, ...] = ()

    @property
    def quoted(self) -> bool:
        return self.run is None


@dataclass(frozen=True)
class Table:
    """One table of the paper, and the sweep of the same key that reproduces it.

    Args:
        key: name of the file in sweeps/.
        number: in the paper, such as "6b" or "A3".
        title: what it compares.
        protocol: what the paper measured it with.
        columns, rows: in the paper's order.
        rank_by: key of the column whose order is compared with the paper's; None without one.
    """

    key: str
    number: str
    title: str
    protocol: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...] = field(repr=False)
    rank_by: str | None = None


@cache
def load_paper(path: Path = PAPER) -> dict[str, Table]:
    """Every table by its key, in the paper's order."""
    raw = OmegaConf.to_container(OmegaConf.load(path))
    kinds = raw["columns"]
    return {key: _table(key, entry, kinds) for key, entry in raw["tables"].items()}


def find_tables(names: str | Sequence[str]) -> list[Table]:
    """The tables called `names`: one, several with commas between, or "all".

    Raises:
        InputError: a name that no table has, with the nearest ones.
    """
    tables = load_paper()
    words = names.split(",") if isinstance(names, str) else list(names)
    if words == ["all"]:
        return list(tables.values())
    for word in words:
        if word not in tables:
            nearest = difflib.get_close_matches(word, tables, n=3, cutoff=0.3) or list(tables)
            raise InputError(
                f"table={word} is unknown: did you mean {', '.join(nearest)}? "
                "All tables: table=all."
            )
    return [tables[word] for word in words]


def _table(key: str, entry: dict, kinds: dict[str, dict]) -> Table:
    columns = tuple(_column(column, kinds) for column in entry["columns"])
    rows = tuple(_row(row, entry) for row in entry["rows"])
    return Table(
        key,
        str(entry["number"]),
        entry["title"],
        entry["protocol"],
        columns,
        rows,
        entry.get("rank_by"),
    )


def _column(key: str, kinds: dict[str, dict]) -> Column:
    """A column's title and direction come from its kind, the last part of its key."""
    *test_set, kind = key.split("/")
    entry = kinds[kind]
    title = " ".join([*test_set, entry["title"]])
    return Column(key, title, entry.get("better"), entry["format"])


def _row(row: dict, table: dict) -> Row:
    """A row's views and size are its table's unless it names its own."""
    return Row(
        name=row["name"],
        paper={key: float(value) for key, value in row["paper"].items()},
        run=tuple(row["run"]) if "run" in row else None,
        views=row.get("views", table["views"]),
        size=tuple(row.get("size", table["size"])),
        post_optimisation=row.get("post_optimisation", 0),
        unverified=row.get("unverified"),
        readings=tuple(
            Reading(reading["name"], tuple(reading["run"])) for reading in row.get("readings", ())
        ),
    )
