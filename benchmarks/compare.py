"""Compare two result files of one suite: what became slower or less exact, beyond noise."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from asysplat.errors import InputError
from benchmarks.table import largest_at, value_at
from benchmarks.timing import Result

MACHINE = ("cpu", "instructions", "cores", "threads", "gpu")  # properties that times depend on
NO_ERROR = 1e-12  # smaller numbers are raised to it, so that ratios stay finite


class Kind(NamedTuple):
    """A kind of metric: its unit, the words for a change, and the smallest change that counts."""

    unit: str  # "dB" is compared by the difference, every other unit by the ratio
    worse: str  # word for a change to the worse
    better: str
    min_change: float  # smallest change that counts: in dB, or of the natural logarithm
    sign: int = 1  # 1 where more is worse, -1 where less is worse
    any_machine: bool = True  # False: compared only with results of the same machine

    def change(self, old: float, new: float) -> float:
        """Return how much worse the number became; a negative change is an improvement."""
        if self.unit == "dB":
            return self.sign * (new - old)
        return self.sign * math.log(max(new, NO_ERROR) / max(old, NO_ERROR))


TIME = Kind("s", "slower", "faster", math.log(1.2), any_machine=False)
RATE = Kind("/ s", "slower", "faster", math.log(1.2), sign=-1, any_machine=False)
RATIO = Kind("x", "slower", "faster", math.log(1.3))
ERROR = Kind("", "less exact", "more exact", math.log(2))
DECIBELS = Kind("dB", "less exact", "more exact", 0.1, sign=-1)
LPIPS_DISTANCE = Kind("", "less exact", "more exact", math.log(1.05))


class TrackedMetrics(NamedTuple):
    """The numbers in a suite's results that are compared with older ones.

    A path such as "error.forward" leads to a value in a row, see `table.value_at`.
    """

    names: tuple[str, ...]  # keys whose values name a row
    must_match: tuple[str, ...]  # paths to what two rows must have in common besides: sizes
    # Paths to a number, to a median with its interquartile range, or to a dictionary of numbers;
    # the largest number of a dictionary is compared.
    kinds: Mapping[str, Kind]
    rows: str = "rows"  # key of the rows in the results


class Value(NamedTuple):
    """A number and its noise: its interquartile range, the noise that its row states, or 0."""

    number: float
    noise: float

    def describe(self, unit: str) -> str:
        noise = f" ± {self.noise:.2g}" if self.noise else ""
        return f"{self.number:.4g}{noise} {unit}".rstrip()


@dataclass
class ResultsComparison:
    """The differences between two result files, one line each."""

    worse: list[str] = field(default_factory=list)  # beyond noise
    better: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # numbers only in the old file
    notes: list[str] = field(default_factory=list)  # on what could not be compared
    compared: int = 0  # count of compared numbers

    def lines(self) -> list[str]:
        """Return all lines; the last one sums them up."""
        missing = [f"not measured any more: {what}" for what in self.missing]
        count = f"{len(self.worse)} of" if self.worse else "green: none of"
        verdict = f"{count} {self.compared} numbers became slower or less exact beyond noise."
        return [*self.notes, *missing, *self.better, *self.worse, verdict]


def read_old(path: str | None, output: Path) -> Result | None:
    """Read the results to compare with; `output`, where new ones are written, must be elsewhere."""
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


def compare(old: Result, new: Result, tracked: TrackedMetrics) -> ResultsComparison:
    """Compare all tracked numbers that both results have.

    A change counts if it exceeds the threshold of its kind, and the sum of the noise of both.
    """
    before, after = _values(old, tracked), _values(new, tracked)
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
        kind = tracked.kinds[path]
        if key not in after:
            comparison.missing.append(f"{name}, {path}: was {was.describe(kind.unit)}")
        elif kind.any_machine or not changed:
            comparison.compared += 1
            is_now = after[key]
            change = kind.change(was.number, is_now.number)
            beyond_noise = abs(is_now.number - was.number) > was.noise + is_now.noise
            if beyond_noise and abs(change) > kind.min_change:
                lines = comparison.worse if change > 0 else comparison.better
                word = kind.worse if change > 0 else kind.better
                values = f"{is_now.describe(kind.unit)}, was {was.describe(kind.unit)}"
                lines.append(f"{word}: {name}, {path}: {values}")
    return comparison


def _values(results: Result, tracked: TrackedMetrics) -> dict[tuple[str, str, str], Value]:
    """Return the tracked numbers by the name of their row, its sizes as JSON, and their path."""
    values = {}
    for row in results.get(tracked.rows, []):
        name = "/".join(str(row[key]) for key in tracked.names if row.get(key) is not None)
        sizes = json.dumps([value_at(row, path) for path in tracked.must_match], sort_keys=True)
        for path in tracked.kinds:
            value = value_at(row, path)
            if isinstance(value, dict) and "median" in value:
                values[name, sizes, path] = Value(value["median"], value["iqr"])
            elif value not in (None, {}):
                noise = value_at(row, f"noise.{path}") or 0.0
                values[name, sizes, path] = Value(float(largest_at(row, path)), noise)
    return values
