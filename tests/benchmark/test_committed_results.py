"""Every committed result of a suite can be read, shown and compared with."""

import json
from copy import deepcopy
from pathlib import Path

import pytest

from benchmarks.compare import compare
from benchmarks.options import SUITES, find_suite
from benchmarks.table import format_json

FOLDER = Path(__file__).parents[2] / "docs" / "results"
FILES = [path for path in sorted(FOLDER.rglob("*.json")) if path.stem in SUITES]
# What each suite measures of a row, and the factor that makes it worse.
MEASURED = {"data": ("views_per_second", 0.1), "bench": ("ratio", 10), "pareto": ("seconds", 10)}
MEASURED |= {"stability": ("error", 10), "formats": ("write", 10), "device": ("kernels", 10)}
MEASURED |= {"machine_code": ("instructions", 2), "launches": ("launches", 2)}
MEASURED |= {"depths": ("absrel", 10)} | dict.fromkeys(
    ("systems", "public", "photographs"), ("psnr", 0.1)
)


def test_every_suite_has_a_committed_result():
    assert {path.stem for path in FILES} == set(SUITES)


@pytest.mark.medium
@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_committed_results_are_shown_and_compared(path):
    results, suite = json.loads(path.read_text()), find_suite(path.stem)
    assert path.read_text() == format_json(results) + "\n"
    assert all(table.row_count > 0 for table in suite.tables(results))
    if hasattr(suite, "plot"):
        assert suite.plot(results).axes

    comparison = compare(results, results, suite.TRACKED)
    assert comparison.compared > 2
    assert comparison.worse == comparison.better == comparison.missing == []
    key, factor = MEASURED.get(path.stem, ("forward", 10))
    slower = deepcopy(results)
    for row in slower[suite.TRACKED.rows]:
        if isinstance(row[key], dict):
            row[key]["median"] *= factor
        elif row[key]:
            row[key] *= factor
    worse = compare(results, slower, suite.TRACKED).worse
    assert worse and all(sentence.startswith(("slower: ", "less exact: ")) for sentence in worse)
