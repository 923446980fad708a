"""The suite on a small scene: its results are complete, and it leaves no file behind."""

import json

import pytest

from asysplat.benchmark.data import CACHES, plot, tables, write_photographs
from asysplat.data import SceneOptions, open_scene
from asysplat.data.images import content_hash

pytestmark = pytest.mark.medium

OVERRIDES = {"scale": "laptop", "width": 0.125, "state_size": 8}


@pytest.fixture(scope="module")
def run(run_suite):
    small = {"frames": 24, "photographs": [36, 64], "overrides": OVERRIDES, "num_workers": 0}
    return lambda **changes: run_suite("data", {"data": small | changes})


def test_rows_are_complete_and_consistent(run):
    results = run()
    assert results["scene"]["frames"] == 24
    assert results["scene"]["photographs"] == [36, 64]
    assert results["open"]["median"] > 0
    assert [row["cache"] for row in results["loading"]] == list(CACHES)
    network = results["network"]["median"]
    for row in results["loading"]:
        assert row["over_network"] == pytest.approx(row["frames_per_second"]["median"] / network)
    assert [len(table.rows) for table in tables(results)] == [1, 3]


def test_whiskers_are_the_interquartile_range(repository):
    results = json.loads((repository / "docs" / "results" / "data.json").read_text())
    (whiskers,) = plot(results).axes[0].containers[-1].lines[2]
    for row, ((left, _), (right, _)) in zip(
        results["loading"], whiskers.get_segments(), strict=True
    ):
        rate = row["frames_per_second"]
        assert (left + right) / 2 == pytest.approx(rate["median"])
        assert right - left == pytest.approx(rate["iqr"])


def test_a_user_scene_stays_unchanged(run, tmp_path):
    write_photographs(tmp_path / "scene", 20, 36, 64)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert run(root=str(tmp_path / "scene"))["scene"]["frames"] == 20
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files


def test_synthetic_photographs_are_different_files_of_one_scene(tmp_path):
    write_photographs(tmp_path, 20, 36, 64)
    scene = open_scene(tmp_path, SceneOptions(36, 64)).scene
    assert len({content_hash(photograph.file) for photograph in scene.images}) == 20
    assert scene.images[0].lens.width == 64
