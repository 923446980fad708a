"""The suite of numbers of photographs: each in a process of its own."""

import pytest
from rich.console import Console

from benchmarks import photographs


@pytest.mark.medium
def test_more_photographs_draw_better_and_take_more_memory(make_options, tmp_path):
    config = {"shared": str(tmp_path), "scenes": ["room"], "views": [2, 12], "side": 32}
    options = make_options("photographs", {"photographs": config | {"seconds": [0]}})
    results = photographs.measure(options, Console(quiet=True))
    few, many = results["rows"]
    assert (few["views"], many["views"]) == (2, 12)
    assert many["psnr"] > few["psnr"] + 1 and many["gb"] > few["gb"]
    assert many["gaussians"] == 12 * 32 * 32
    (table,) = photographs.tables(results | {"machine": {"cpu": "a"}, "revision": "b"})
    assert table.row_count == 2
    assert [len(axes.lines) for axes in photographs.plot(results).axes] == [1, 1, 1]
