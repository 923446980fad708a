"""Read the paper's tables, every number of which is in paper.yaml."""

import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from omegaconf import OmegaConf

from asysplat.errors import InputError

MEMORY = ("train_gb", "inference_gb")  # columns
Number = int | float
Costs = dict[str, Number]  # see `static_costs`


@dataclass(frozen=True)
class Column:
    """One kind of number."""

    key: str  # "parameters", "gflops", ..., or "<test set>/<metric>" such as "dl3dv/psnr"
    kind: str  # as printed, such as "PSNR"
    better: str | None  # "higher" or "lower"; None if neither is
    format: str  # format of one number in `unit`, as for str.format
    unit: float = 1.0  # the value of the unit in `kind`, such as 1e6 for (M)

    @property
    def test_set(self) -> str:
        """Return the key of its test set; "" if the number belongs to none."""
        return self.key.rpartition("/")[0]

    def title(self, test_set: str | None = None) -> str:
        """Return the paper's title, or the title of this kind of number on `test_set`."""
        if not self.test_set:
            return self.kind
        return f"{test_set or set_titles()[self.test_set]} {self.kind}"

    def text(self, value: float) -> str:
        """Format a number as the paper prints it."""
        return self.format.format(value / self.unit)


@dataclass(frozen=True)
class PaperRow:
    """One method of a table, with our numbers once it is filled."""

    name: str  # as printed, with what distinguishes it from the table's other rows
    numbers: dict[str, float]  # column key -> the paper's number
    run: tuple[str, ...] | None  # overrides of train.py; None for another system, which is quoted
    views: int  # input views for its costs
    size: tuple[int, int]  # height and width for its costs
    # Column key -> the bound that the paper prints in place of a number: "<1"
    bounds: dict[str, str] = field(default_factory=dict)
    post_optimization: int = 0  # steps on the Gaussians; such rows need evaluate.py
    test_set: str | None = None  # test set of our run, in place of the one from `our_sets`
    also: tuple[str, ...] = ()  # overrides of other runs that fill the row where `run` has none
    unverified: str | None = None  # why its architecture may differ from the paper's
    # The other architectures that the paper's text allows: name -> overrides
    readings: dict[str, tuple[str, ...]] = field(default_factory=dict)

    costs: Costs | None = None  # at the paper's scale; None if not requested, and for quoted rows
    reading_costs: tuple[Costs, ...] = ()  # one for each of `readings`, or empty if not requested
    # Column key -> measured numbers, one for each seed; a column without any is left out
    values: dict[str, list[Number]] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()  # seeds of the runs
    folders: tuple[str, ...] = ()  # folders of the runs
    revisions: tuple[str, ...] = ()  # revisions of their code, see `asysplat.runs.machine`
    note: str = ""  # a remark on this row, such as "seeds still to run: 2"
    options: tuple[str, ...] = ()  # options that end the note, the most important first

    @property
    def label(self) -> str:
        return self.name + (" †" if self.unverified else "")

    @property
    def quoted(self) -> bool:
        return self.run is None

    def text(self, column: Column) -> str:
        """Return what the paper prints in `column`; "" if it prints nothing."""
        if column.key in self.numbers:
            return column.text(self.numbers[column.key])
        return self.bounds.get(column.key, "")


@dataclass(frozen=True)
class Claim:
    """A number that the text computes from rows of a table."""

    text: str  # the paper's words, or ours
    stated: bool  # whether the paper states it
    form: str  # see `compare.claim_value`
    table: str  # key
    column: Column
    rows: tuple[tuple[PaperRow, ...], ...]  # those compared, and those that they are compared with


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper, or one of ours, and the sweep of the same key that reproduces it."""

    key: str  # name of the file in conf/sweeps/, or "claims"
    number: str | None  # in the paper, such as "6b" or "A3"; None for claims and tables of ours
    title: str  # what it compares
    protocol: str  # how the paper measured it
    columns: tuple[Column, ...]
    rows: tuple[PaperRow, ...] = field(repr=False)  # in the paper's order
    rank_by: str | None = None  # key of the column whose order is compared with the paper's
    base: str | None = None  # name of the row that the others of an ablation differ from
    claims: tuple[Claim, ...] = field(default=(), repr=False)  # in place of columns and rows

    # Our numbers
    sets: dict[str, str] = field(default_factory=dict)  # the paper's test set -> ours
    memory: str = ""  # what the runs measured of MEMORY; "" without runs
    metrics: tuple[str, ...] = ()  # the protocols, a sentence for each; several if runs differ
    # Label -> how they were made: Ours (the scale), Head (of the models), Not tested (the paper's
    # test sets whose path no run was given), Baselines, Data, Machine, Command; "" if unknown
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def heading(self) -> str:
        if self.number is None:
            return f"{'Claims' if self.claims else 'Ours'}: {self.title}"
        return f"Table {self.number}: {self.title}"

    @property
    def ranked_column(self) -> Column | None:
        """Return the column whose order is compared with the paper's."""
        return next((c for c in self.columns if c.key == self.rank_by), None)

    def our_title(self, column: Column) -> str:
        """Return the title of our numbers: our test set if it is another, what memory is."""
        ours = self.sets.get(column.test_set, column.test_set)
        title = column.title(None if ours == column.test_set else ours)
        return f"{title}, {self.memory}" if column.key in MEMORY and self.memory else title

    @property
    def test_sets(self) -> list[str]:
        return list(dict.fromkeys(c.test_set for c in self.columns if c.test_set))


@cache
def load_paper() -> dict[str, PaperTable]:
    """Read every table of the paper; by key, in its order."""
    return {key: _table(key, entry) for key, entry in _read()["tables"].items()}


@cache
def load_claims() -> PaperTable:
    """Read what the paper's text says of its tables."""
    entry, tables = _read()["claims"], load_paper()
    claims = []
    for claim in entry["claims"]:
        rows = {row.name: row for row in tables[claim["table"]].rows}
        sides = tuple(tuple(rows[name] for name in side) for side in claim["rows"])
        text, column = claim.get("text") or claim["ours"], _column(claim["column"])
        claims.append(Claim(text, "text" in claim, claim["form"], claim["table"], column, sides))
    return PaperTable(
        "claims", None, entry["title"], entry["protocol"], (), (), claims=tuple(claims)
    )


def find_tables(names: str | Sequence[str]) -> list[PaperTable]:
    """Find tables of the paper, or "claims", by name: one, several with commas, or "all"."""
    tables = load_paper() | {"claims": load_claims()}
    names = names.split(",") if isinstance(names, str) else list(names)
    if names == ["all"]:
        return list(tables.values())
    for name in names:
        if name not in tables:
            nearest = difflib.get_close_matches(name, tables, n=3, cutoff=0.3) or tables
            raise InputError(
                f"table={name} is unknown: did you mean {', '.join(nearest)}? "
                "All tables: table=all."
            )
    return [tables[name] for name in names]


def our_sets(table: PaperTable, data: str, test_sets: Collection[str]) -> dict[str, str]:
    """Map each test set of a table to the test set of ours that is compared with it.

    It is the substitute that this data has for it. Without one, it is the data itself for the
    table's first set, if the sweep does not name that set; otherwise it is the set itself.

    Args:
        data: the data set of the runs, which is tested as well.
        test_sets: the further ones that their configuration names.
    """
    substitutes = _read()["substitutes"].get(data, {})
    sets = {key: substitutes.get(key, key) for key in table.test_sets}
    for first in table.test_sets[:1]:
        if first not in test_sets and first not in substitutes:
            sets[first] = data
    return sets


def set_titles() -> dict[str, str]:
    """Return the paper's test sets, as it prints them, by key."""
    return _read()["test_sets"]


@cache
def _read() -> dict:
    return OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("paper.yaml")))


def stage_hours(steps: Number, seconds_per_step: Number) -> float:
    """Compute the hours of a stage of training."""
    return steps * seconds_per_step / 3600


def _column(key: str) -> Column:
    kind = _read()["columns"][key.rpartition("/")[-1]]
    unit = float(kind.get("unit", 1))
    return Column(key, kind["title"], kind.get("better"), kind["format"], unit)


def _table(key: str, entry: dict) -> PaperTable:
    columns = map(_column, (*entry["columns"], *entry.get("computed", ())))
    rows = tuple(_row(row, entry) for row in entry["rows"])
    number = None if entry["number"] is None else str(entry["number"])
    title, protocol = entry["title"], entry["protocol"]
    order = {"rank_by": entry.get("rank_by"), "base": entry.get("base")}
    return PaperTable(key, number, title, protocol, tuple(columns), rows, **order)


def _row(row: dict, table: dict) -> PaperRow:
    columns = table["columns"]
    printed = dict(zip(columns, row.get("paper", [None] * len(columns)), strict=True))
    if "train_hours" in table.get("computed", ()):
        hours = stage_hours(printed["train_steps"], printed["seconds_per_step"])
        printed["train_hours"] = hours
    return PaperRow(
        name=row["name"],
        numbers={key: float(v) for key, v in printed.items() if isinstance(v, int | float)},
        run=tuple(row["run"]) if "run" in row else None,
        views=row.get("views", table["views"]),
        size=tuple(row.get("size", table["size"])),
        bounds={key: v for key, v in printed.items() if isinstance(v, str)},
        post_optimization=row.get("post_optimization", 0),
        test_set=row.get("test_set"),
        unverified=row.get("unverified"),
        also=tuple(row.get("also", ())),
        readings={r["name"]: tuple(r["run"]) for r in row.get("readings", ())},
    )
