"""The tables and pictures of the results in docs/ can be made anew."""

import json
from io import StringIO

import pytest
from rich.console import Console

from asysplat.benchmark.options import find_suite

# Cells as they were published; a suite's later columns may be empty in an older file.
CELLS = {
    "render": ["15.2 ± 4.9", "3.1e-07", "1.7e-06*", "7934.2 ± 1063.5", "no ellipse skip"],
    "ops": ["166.6 ± 13.4", "1.5e-07*", "28.0", "102.0", "1.06"],
    "model": ["20957.8 ± 0.0", "50449.0 ± 0.0", "1.73", "1,868", "of which grid_attention"],
    "growth/model": ["10320.5 ± 0.0", "1.28", "192"],
    "parts/reconstruct": ["28.77", "0.039", "831", "34.7 ± 1.1", "1.27", "no_cool_down"],
    "budgets/reconstruct": ["29.51", "33.59", "mcmc"],
    "bench": ["selective_scan", "its chunked", "its products"],
    "data": ["179.6 ± 6.0", "1329 ± 46", "33.1", "40 ± 5 frames / s"],
}


@pytest.mark.parametrize("name", CELLS)
def test_tables_and_picture(repository, name):
    results = json.loads((repository / "docs" / "results" / f"{name}.json").read_text())
    suite = find_suite(name.rpartition("/")[2])
    console = Console(width=500, file=StringIO())
    for table in suite.tables(results):
        console.print(table)
    text = console.file.getvalue()
    assert [cell for cell in CELLS[name] if cell not in text] == []
    assert results["machine"]["cpu"] in text
    assert suite.plot(results).axes
