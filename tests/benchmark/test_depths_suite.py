"""The suite of depths: a room whose depths are known."""

from rich.console import Console

from asysplat.data import ProceduralScene
from benchmarks import depths


def test_a_sweep_is_compared_with_the_truth(make_options, monkeypatch):
    room = ProceduralScene(3, 128, 128, num_images=24, places="rooms").views(range(0, 24, 4))
    monkeypatch.setattr(depths, "scenes", lambda: iter([("rooms 0", room)]))
    results = depths.measure(make_options("depths", {}), Console(quiet=True))
    (row,) = results["rows"]
    assert row["views"] == 6 and 0.3 < row["sure"] < 0.9
    assert 0 < row["absrel_sure"] < row["absrel"] < 0.1 and row["delta1"] > 0.9
    (table,) = depths.tables(results | {"machine": {"cpu": "a"}})
    assert table.row_count == 2  # the room, and the mean of rooms
