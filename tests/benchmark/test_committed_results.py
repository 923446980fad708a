"""The committed results in docs/ can be read, shown and compared with."""

import json
from copy import deepcopy
from io import StringIO

import pytest
from rich.console import Console

from asysplat.benchmark.compare import compare
from asysplat.benchmark.options import find_suite
from asysplat.benchmark.table import dumps

# Cells as they were published; a suite's later columns may be empty in an older file.
CELLS = {
    "render": ["15.2 ± 4.9", "3.1e-07", "1.7e-06*", "7934.2 ± 1063.5", "no ellipse culling"],
    "ops": ["166.6 ± 13.4", "1.5e-07*", "28.0", "102.0"],
    "model": ["20957.8 ± 0.0", "50449.0 ± 0.0", "of which grid_attention"],
    "growth/model": ["10320.5 ± 0.0", "asysplat_4m4s"],
    "bench": ["selective_scan", "its chunked", "its products"],
    "data": ["179.6 ± 6.0", "1329 ± 46"],
    "pareto": ["plane_sweep_48", "22.59", "Refined, means over scenes"],
}
TIMED = {"data": "frames_per_second", "bench": "ratio", "pareto": "seconds"}


@pytest.fixture
def path(repository):
    return lambda name: repository / "docs" / "results" / f"{name}.json"


@pytest.fixture
def read(path):
    return lambda name: json.loads(path(name).read_text())


@pytest.mark.parametrize("name", CELLS)
def test_tables_and_figure(path, read, name):
    results, suite = read(name), find_suite(name.rpartition("/")[2])
    assert path(name).read_text() == dumps(results) + "\n"
    console = Console(width=500, file=StringIO())
    for table in suite.tables(results):
        console.print(table)
    text = " ".join(console.file.getvalue().split())  # notes are wrapped
    assert [cell for cell in CELLS[name] if cell not in text] == []
    assert results["machine"]["cpu"] in text
    if hasattr(suite, "plot"):
        assert suite.plot(results).axes


@pytest.mark.parametrize("name", CELLS)
def test_results_are_compared_with_themselves(read, name):
    suite, results = find_suite(name.rpartition("/")[2]), read(name)
    comparison = compare(results, results, suite.WATCHED)
    assert comparison.compared > 2
    assert comparison.worse == comparison.better == comparison.missing == []
    slower, key = deepcopy(results), TIMED.get(name, "forward")
    for row in slower[suite.WATCHED.rows]:
        if row[key]:
            row[key]["median"] *= 0.1 if name == "data" else 10
    worse = compare(results, slower, suite.WATCHED).worse
    assert worse and all(sentence.startswith("slower: ") for sentence in worse)
