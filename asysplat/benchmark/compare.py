"""Two files of one suite: what became slower or less exact, beyond noise."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from asysplat.benchmark.table import at
from asysplat.benchmark.timing import Result
from asysplat.errors import InputError

MACHINE = ("cpu", "instructions", "cores", "threads", "gpu")  # what times depend on
NO_ERROR = 1e-12  # an error below is none


@dataclass(frozen=True)
class Kind:
    """What a number says, and from which change on that counts.

    Args:
        unit: of the number; dB are compared by their difference, all others by their ratio.
        worse, better: words for a change.
        least: change that counts, of the logarithm or in dB.
        sign: 1 where more is worse, -1 where less is.
        anywhere: whether it may be compared with another machine's.
    """

    unit: str
    worse: str
    better: str
    least: float
    sign: int = 1
    anywhere: bool = True

    def change(self, old: float, new: float) -> float:
        """Return how much worse it became; below 0 where it became better."""
        if self.unit == "dB":
            return self.sign * (new - old)
        return self.sign * math.log(max(new, NO_ERROR) / max(old, NO_ERROR))


TIME = Kind("s", "slower", "faster", math.log(1.2), anywhere=False)
RATE = Kind("/ s", "slower", "faster", math.log(1.2), sign=-1, anywhere=False)
RATIO = Kind("x", "slower", "faster", math.log(1.3))
ERROR = Kind("", "less exact", "more exact", math.log(2))
DECIBELS = Kind("dB", "less exact", "more exact", 0.1, sign=-1)
LPIPS_DISTANCE = Kind("", "less exact", "more exact", math.log(1.05))


class Watched(NamedTuple):
    """What is compared of a suite's results.

    Args:
        names: keys of a row that name it.
        alike: paths in a row of what must be equal, too: sizes.
        kinds: by the path of a number in a row, or of its median and interquartile range, or of
            several numbers, of which the largest counts.
        rows: the key of the rows in the results.
    """

    names: tuple[str, ...]
    alike: tuple[str, ...]
    kinds: Mapping[str, Kind]
    rows: str = "rows"


class Key(NamedTuple):
    """Which number: of which row, with which sizes as JSON, at which path in it."""

    name: str
    sizes: str
    path: str


class Value(NamedTuple):
    """A number with its interquartile range, 0 where it has none."""

    median: float
    iqr: float

    def text(self, unit: str) -> str:
        spread = f" ± {self.iqr:.2g}" if self.iqr else ""
        return f"{self.median:.4g}{spread} {unit}".rstrip()


@dataclass
class Comparison:
    """What two files say, in sentences.

    Args:
        worse, better: beyond noise.
        missing: measured then, and not now.
        notes: on what could not be compared.
        compared: how many numbers were.
    """

    worse: list[str] = field(default_factory=list)
    better: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    compared: int = 0

    def sentences(self) -> list[str]:
        """Return all of it, the verdict last."""
        missing = [f"not measured any more: {what}" for what in self.missing]
        verdict = f"{len(self.worse)} of {self.compared} numbers became slower or less exact"
        if not self.worse:
            verdict = f"green: none of {self.compared} numbers became slower or less exact"
        return [*self.notes, *missing, *self.better, *self.worse, f"{verdict} beyond noise."]


def read_old(path: str | None, written: Path) -> Result | None:
    """Read the results to compare with, if a path is given.

    Args:
        written: where the new ones go.

    Raises:
        InputError: there is no such file, it is none of benchmark.py, or would be written over.
    """
    if path is None:
        return None
    try:
        results = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"compare={path} cannot be read ({error}): name a .json file that benchmark.py wrote."
        ) from error
    if not isinstance(results, dict) or not isinstance(results.get("machine"), dict):
        raise InputError(f"compare={path} has no results: name a .json file of benchmark.py.")
    if results.get("suite", written.stem) != written.stem:
        raise InputError(
            f"compare={path} is of suite={results['suite']}: name a file of suite={written.stem}."
        )
    if Path(path).resolve() == written.resolve():
        raise InputError(f"compare={path} would be written over: set output= to another folder.")
    return results


def compare(old: Result, new: Result, watched: Watched) -> Comparison:
    """Compare all numbers that both have.

    A change counts where it is larger than its kind's least and than the spread of both.

    Raises:
        InputError: they have no row in common.
    """
    before, now = watched_values(old, watched), watched_values(new, watched)
    if before and not before.keys() & now.keys():
        raise InputError(
            "compare= has none of the rows that were measured: name a file of the same suite, "
            "with the same scenes and sizes."
        )
    found = Comparison()
    differing = [key for key in MACHINE if old["machine"].get(key) != new["machine"].get(key)]
    if differing:
        said = ", ".join(
            f"{key} {old['machine'].get(key)} then and {new['machine'].get(key)} now"
            for key in differing
        )
        found.notes.append(f"another machine: {said}; seconds are not compared.")
    for key, was in before.items():
        kind = watched.kinds[key.path]
        if key not in now:
            found.missing.append(f"{key.name}, {key.path}: was {was.text(kind.unit)}")
        elif kind.anywhere or not differing:
            _judge(f"{key.name}, {key.path}", kind, was, now[key], found)
    return found


def watched_values(results: Result, watched: Watched) -> dict[Key, Value]:
    """Return all numbers that are watched."""
    found = {}
    for row in results.get(watched.rows, []):
        name = "/".join(str(row[key]) for key in watched.names if row.get(key) is not None)
        sizes = json.dumps([at(row, path) for path in watched.alike])
        found |= {Key(name, sizes, path): value for path, value in _values(row, watched.kinds)}
    return found


def _values(row: Result, kinds: Mapping[str, Kind]) -> Iterator[tuple[str, Value]]:
    for path in kinds:
        value = _value(at(row, path))
        if value is not None:
            yield path, value


def _value(found: Any) -> Value | None:
    """Read a number, a summary of several, or the largest of numbers with names of their own."""
    if isinstance(found, dict):
        if "median" in found:
            return Value(found["median"], found["iqr"])
        return Value(max(found.values()), 0.0) if found else None
    return None if found is None else Value(found, 0.0)


def _judge(name: str, kind: Kind, was: Value, now: Value, found: Comparison) -> None:
    """Add a sentence where the change counts."""
    found.compared += 1
    change = kind.change(was.median, now.median)
    beyond_noise = abs(now.median - was.median) > was.iqr + now.iqr
    if abs(change) > kind.least and beyond_noise:
        word, sentences = (kind.worse, found.worse) if change > 0 else (kind.better, found.better)
        sentences.append(f"{word}: {name}: {now.text(kind.unit)}, was {was.text(kind.unit)}")
