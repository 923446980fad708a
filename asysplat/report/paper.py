"""The paper's tables as values, and ours: paper.yaml holds every number that the paper prints.

ours.yaml has the rows of tables that the paper does not have.
"""

import difflib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from omegaconf import OmegaConf

from asysplat.errors import InputError

PAPER = Path(__file__).with_name("paper.yaml")
OURS = Path(__file__).with_name("ours.yaml")


@dataclass(frozen=True)
class Column:
    """One kind of number.

    Args:
        key: "parameters", "gflops", ..., or "<test set>/<metric>" such as "dl3dv/psnr".
        kind: of number, as printed, such as "PSNR".
        better: "higher" or "lower"; None where neither is.
        format: of one number in `unit`, as for str.format.
        unit: what the title's unit is worth, such as 1e6 where it says (M).
    """

    key: str
    kind: str
    better: str | None
    format: str
    unit: float = 1.0

    @property
    def test_set(self) -> str:
        """Return the key of its test set; "" where the number belongs to none."""
        return self.key.rpartition("/")[0]

    @property
    def title(self) -> str:
        """Return the title that the paper prints."""
        return self.title_of(set_titles()[self.test_set]) if self.test_set else self.kind

    def title_of(self, test_set: str) -> str:
        """Return the title of the same kind of number, measured on a set of this name."""
        return f"{test_set} {self.kind}"

    def text(self, value: float) -> str:
        """Write a number, the paper's or ours, as the paper prints it."""
        return self.format.format(value / self.unit)


@dataclass(frozen=True)
class Reading:
    """Another architecture that the paper's text allows.

    Args:
        name: what it changes.
        run: overrides of train.py that build it.
    """

    name: str
    run: tuple[str, ...]


@dataclass(frozen=True)
class PaperRow:
    """One method of a table.

    Args:
        name: as the paper prints it, with what sets it apart from the table's other rows.
        numbers: column key -> the paper's number.
        run: overrides of train.py that give it; None for a method that is only quoted.
        views, size: input views, height and width that its costs are computed at.
        bounds: column key -> what the paper prints where it gives only a bound: "<1".
        post_optimization: steps on the Gaussians; such rows need evaluate.py.
        test_set: of the run, in the place of the stand-in; None for the stand-in.
        unverified: why the architecture of this row is not known to be the paper's; None where it
            is.
        readings: the other architectures of an unverified row.
    """

    name: str
    numbers: dict[str, float]
    run: tuple[str, ...] | None
    views: int
    size: tuple[int, int]
    bounds: dict[str, str] = field(default_factory=dict)
    post_optimization: int = 0
    test_set: str | None = None
    unverified: str | None = None
    readings: tuple[Reading, ...] = ()

    @property
    def quoted(self) -> bool:
        return self.run is None

    def text(self, column: Column) -> str:
        """Return what the paper prints in `column`; "" where it prints nothing."""
        if column.key in self.numbers:
            return column.text(self.numbers[column.key])
        return self.bounds.get(column.key, "")


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper, and the sweep of the same key that reproduces it; or one of ours.

    Args:
        key: name of the file in sweeps/.
        number: in the paper, such as "6b" or "A3"; None of a table of ours, which has no numbers of
            the paper.
        title: what it compares.
        protocol: what the paper measured it with.
        columns, rows: in the paper's order.
        rank_by: key of the column whose order is compared with the paper's; None without one.
    """

    key: str
    number: str | None
    title: str
    protocol: str
    columns: tuple[Column, ...]
    rows: tuple[PaperRow, ...] = field(repr=False)
    rank_by: str | None = None

    @property
    def test_sets(self) -> list[str]:
        """List the test sets of its columns, in order."""
        return list(dict.fromkeys(c.test_set for c in self.columns if c.test_set))


@cache
def load_paper() -> dict[str, PaperTable]:
    """Read every table of the paper; by key, in its order."""
    return {key: _table(key, entry) for key, entry in _raw()["tables"].items()}


@cache
def load_ours() -> dict[str, PaperTable]:
    """Read every table of ours; by key."""
    tables = OmegaConf.to_container(OmegaConf.load(OURS))["tables"]
    return {key: _table(key, entry) for key, entry in tables.items()}


def find_tables(names: str | Sequence[str]) -> list[PaperTable]:
    """Find the tables called `names`, the paper's and ours: one, some with commas, or "all".

    Raises:
        InputError: a name that no table has, with the nearest ones.
    """
    tables = load_paper() | load_ours()
    names = names.split(",") if isinstance(names, str) else list(names)
    if names == ["all"]:
        return list(tables.values())
    for name in names:
        if name not in tables:
            raise InputError(
                f"table={name} is unknown: did you mean {_nearest(name, tables)}? "
                "All tables: table=all."
            )
    return [tables[name] for name in names]


def our_sets(table: PaperTable, data: str, test_sets: Collection[str]) -> dict[str, str]:
    """Map each test set of a table to the one of ours whose numbers stand beside the paper's.

    It is the stand-in that this data has for it. Without one, it is the data itself for the table's
    first set, if the sweep does not name that set; otherwise it is the set itself.

    Args:
        data: the data set of the runs, which is tested as well.
        test_sets: the further ones that their configuration names.
    """
    stand_ins = _raw()["stand_ins"].get(data, {})
    itself = {key: key for key in table.test_sets}
    first = {key: data for key in table.test_sets[:1] if key not in test_sets}
    return itself | first | {key: stand_ins[key] for key in itself if key in stand_ins}


def set_titles() -> dict[str, str]:
    """Return the paper's test sets, as it prints them, by key."""
    return _raw()["test_sets"]


def kind_titles() -> dict[str, str]:
    """Return the kinds of numbers, as printed, by the last part of a column's key."""
    return {kind: entry["title"] for kind, entry in _raw()["columns"].items()}


@cache
def _raw() -> dict:
    return OmegaConf.to_container(OmegaConf.load(PAPER))


def _nearest(name: str, known: Iterable[str]) -> str:
    return ", ".join(difflib.get_close_matches(name, known, n=3, cutoff=0.3) or known)


def _table(key: str, entry: dict) -> PaperTable:
    return PaperTable(
        key,
        None if entry["number"] is None else str(entry["number"]),
        entry["title"],
        entry["protocol"],
        tuple(_column(column) for column in entry["columns"]),
        tuple(_row(row, entry) for row in entry["rows"]),
        entry.get("rank_by"),
    )


def _column(key: str) -> Column:
    """Make a column from its key, whose last part is the kind of its numbers."""
    entry = _raw()["columns"][key.rpartition("/")[-1]]
    unit = float(entry.get("unit", 1))
    return Column(key, entry["title"], entry.get("better"), entry["format"], unit)


def _row(row: dict, table: dict) -> PaperRow:
    """Make a row; its views and size are its table's unless it names its own."""
    printed = dict(zip(table["columns"], row["paper"], strict=True)) if "paper" in row else {}
    return PaperRow(
        name=row["name"],
        numbers={k: float(v) for k, v in printed.items() if isinstance(v, int | float)},
        run=tuple(row["run"]) if "run" in row else None,
        views=row.get("views", table["views"]),
        size=tuple(row.get("size", table["size"])),
        bounds={k: v for k, v in printed.items() if isinstance(v, str)},
        post_optimization=row.get("post_optimization", 0),
        test_set=row.get("test_set"),
        unverified=row.get("unverified"),
        readings=tuple(
            Reading(reading["name"], tuple(reading["run"])) for reading in row.get("readings", ())
        ),
    )
