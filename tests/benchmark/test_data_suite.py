"""The suite on a small scene."""

import pytest

from asysplat.data import SceneOptions, open_scene
from asysplat.data.images import content_hash
from benchmarks.data import CACHES, tables, write_photographs

pytestmark = pytest.mark.medium


def test_rows_are_complete_and_consistent(run_suite):
    small = {"frames": 24, "photographs": [36, 64], "num_workers": 0}
    results = run_suite("data", {"data": small})
    assert results["scene"]["frames"] == 24
    assert results["scene"]["photographs"] == [36, 64]
    assert results["open"]["median"] > 0
    assert [row["cache"] for row in results["loading"]] == list(CACHES)
    assert all(row["frames_per_second"]["median"] > 0 for row in results["loading"])
    assert [len(table.rows) for table in tables(results)] == [2]


def test_synthetic_photographs_are_different_files_of_one_scene(tmp_path):
    write_photographs(tmp_path, 20, 36, 64)
    scene = open_scene(tmp_path, SceneOptions(36, 64)).scene
    assert len({content_hash(photograph.file) for photograph in scene.images}) == 20
    assert scene.images[0].lens.width == 64
