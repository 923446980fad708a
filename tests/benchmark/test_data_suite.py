"""The suite on a small scene."""

import pytest

from benchmarks.data import CACHES, tables


@pytest.mark.medium
def test_rows_are_complete(run_suite):
    small = {"frames": 24, "photographs": [36, 64], "num_workers": 0}
    results = run_suite("data", {"data": small})
    assert results["scene"]["frames"] == 24 and results["open"]["median"] > 0
    assert [row["cache"] for row in results["loading"]] == list(CACHES)
    assert all(row["frames_per_second"]["median"] > 0 for row in results["loading"])
    assert [len(table.rows) for table in tables(results)] == [2]
