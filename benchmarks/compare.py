"""Compare two result files of one suite: what became slower or less exact, beyond noise."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from asysplat.errors import InputError
from benchmarks.table import at, worst
from benchmarks.timing import Result

MACHINE = ("cpu", "instructions", "cores", "threads", "gpu")  # what times depend on
NO_ERROR = 1e-12  # errors below are taken for it


class Kind(NamedTuple):
    """The kind of a number, and from which change on it counts."""

    unit: str  # dB are compared by their difference, all others by their ratio
    worse: str  # words for a change
    better: str
    min_change: float  # smallest change that counts, of the logarithm or in dB
    sign: int = 1  # where more is worse; -1 where less is
    any_machine: bool = True  # whether it may be compared with another machine's

    def change(self, old: float, new: float) -> float:
        """Return how much worse the number became; below 0 where it became better."""
        if self.unit == "dB":
            return self.sign * (new - old)
        return self.sign * math.log(max(new, NO_ERROR) / max(old, NO_ERROR))


TIME = Kind("s", "slower", "faster", math.log(1.2), any_machine=False)
RATE = Kind("/ s", "slower", "faster", math.log(1.2), sign=-1, any_machine=False)
RATIO = Kind("x", "slower", "faster", math.log(1.3))
ERROR = Kind("", "less exact", "more exact", math.log(2))
DECIBELS = Kind("dB", "less exact", "more exact", 0.1, sign=-1)
LPIPS_DISTANCE = Kind("", "less exact", "more exact", math.log(1.05))


class Watched(NamedTuple):
    """What is compared of a suite's results."""

    names: tuple[str, ...]  # keys of a row that name it
    alike: tuple[str, ...]  # paths in a row of what must be equal, too: sizes
    # By the path in a row of a number, of a median with its interquartile range, or of several
    # numbers, of which the largest is compared.
    kinds: Mapping[str, Kind]
    rows: str = "rows"  # the key of the rows in the results


class Value(NamedTuple):
    """A number with its interquartile range or the noise that its row names, else 0."""

    median: float
    iqr: float

    def text(self, unit: str) -> str:
        iqr = f" ± {self.iqr:.2g}" if self.iqr else ""
        return f"{self.median:.4g}{iqr} {unit}".rstrip()


@dataclass
class ResultsComparison:
    """The differences of two files, in words."""

    worse: list[str] = field(default_factory=list)  # beyond noise
    better: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # only in the old file
    notes: list[str] = field(default_factory=list)  # on what could not be compared
    compared: int = 0  # numbers

    def lines(self) -> list[str]:
        """Return all lines, the verdict last."""
        missing = [f"not measured any more: {what}" for what in self.missing]
        count = f"{len(self.worse)} of" if self.worse else "green: none of"
        verdict = f"{count} {self.compared} numbers became slower or less exact beyond noise."
        return [*self.notes, *missing, *self.better, *self.worse, verdict]


def read_old(path: str | None, output: Path) -> Result | None:
    """Read the results to compare with, if a path is given; the new ones are written to `output`.

    Raises:
        InputError: the file cannot be read, is none of this suite, or would be written over.
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
    if results.get("suite", output.stem) != output.stem:
        raise InputError(
            f"compare={path} is of suite={results['suite']}: name a file of suite={output.stem}."
        )
    if Path(path).resolve() == output.resolve():
        raise InputError(f"compare={path} would be written over: set output= to another folder.")
    return results


def compare(old: Result, new: Result, watched: Watched) -> ResultsComparison:
    """Compare all numbers that both results have.

    A change counts where it is larger than its kind's threshold and than both interquartile ranges.

    Raises:
        InputError: the results have no row in common.
    """
    before, after = _values(old, watched), _values(new, watched)
    if before and not before.keys() & after.keys():
        raise InputError(
            "compare= has none of the rows that were measured: name a file of the same suite, "
            "with the same scenes and sizes."
        )
    comparison = ResultsComparison()
    machines = [(key, old["machine"].get(key), new["machine"].get(key)) for key in MACHINE]
    changed = [f"{key} {was} then and {value} now" for key, was, value in machines if was != value]
    if changed:
        note = f"another machine: {', '.join(changed)}; seconds are not compared."
        comparison.notes.append(note)
    for key, was in before.items():
        name, _, path = key
        kind = watched.kinds[path]
        if key not in after:
            comparison.missing.append(f"{name}, {path}: was {was.text(kind.unit)}")
        elif kind.any_machine or not changed:
            comparison.compared += 1
            is_now = after[key]
            change = kind.change(was.median, is_now.median)
            beyond_noise = abs(is_now.median - was.median) > was.iqr + is_now.iqr
            if beyond_noise and abs(change) > kind.min_change:
                lines = comparison.worse if change > 0 else comparison.better
                word = kind.worse if change > 0 else kind.better
                values = f"{is_now.text(kind.unit)}, was {was.text(kind.unit)}"
                lines.append(f"{word}: {name}, {path}: {values}")
    return comparison


def _values(results: Result, watched: Watched) -> dict[tuple[str, str, str], Value]:
    """Return all watched numbers by their row's name, its sizes as JSON, and the path in it."""
    values = {}
    for row in results.get(watched.rows, []):
        name = "/".join(str(row[key]) for key in watched.names if row.get(key) is not None)
        sizes = json.dumps([at(row, path) for path in watched.alike], sort_keys=True)
        for path in watched.kinds:
            value = at(row, path)
            if isinstance(value, dict) and "median" in value:
                values[name, sizes, path] = Value(value["median"], value["iqr"])
            elif value not in (None, {}):
                noise = at(row, f"noise.{path}") or 0.0
                values[name, sizes, path] = Value(worst(row, path), noise)
    return values
