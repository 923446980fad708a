"""The suite on a small scene: what it finds is complete, and nothing of it is left behind."""

import json
import runpy

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.data.suite import CACHES, plot, tables
from asysplat.data import open_scene
from asysplat.data.images import content_hash

pytestmark = pytest.mark.medium

OVERRIDES = {"scale": "laptop", "width": 0.125, "state_size": 8}


@pytest.fixture(scope="module")
def run(repository, tmp_path_factory):
    """The numbers that benchmark.py writes for these options."""

    def benchmark(**changes):
        folder = tmp_path_factory.mktemp("benchmark")
        script = runpy.run_path(str(repository / "benchmark.py"))
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            options = compose("benchmark", ["suite=data", "repeats=2", "device=cpu"])
            OmegaConf.set_struct(options, False)  # the overrides are the user's
            small = {
                "frames": 24,
                "photographs": [36, 64],
                "overrides": OVERRIDES,
                "num_workers": 0,
            }
            changes = {"data": small | changes, "output": str(folder)}
            script["benchmark"](OmegaConf.merge(options, changes))
        assert (folder / "data.png").stat().st_size > 0
        return json.loads((folder / "data.json").read_text())

    return benchmark


def test_rows_are_complete_and_consistent(run):
    results = run()
    assert results["scene"]["frames"] == 24
    assert results["scene"]["photographs"] == [36, 64]
    assert results["open"]["median"] > 0
    assert [row["cache"] for row in results["loading"]] == list(CACHES)
    taken = results["network"]["median"]
    for row in results["loading"]:
        assert row["over_network"] == pytest.approx(row["frames_per_second"]["median"] / taken)
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


def test_a_scene_of_the_user_s_is_left_as_it_was(run, tmp_path):
    write_photographs(tmp_path / "scene", 20, 36, 64)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert run(root=str(tmp_path / "scene"))["scene"]["frames"] == 20
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files


def test_synthetic_photographs_are_different_files_of_one_walk(tmp_path):
    write_photographs(tmp_path, 20, 36, 64)
    scene = open_scene(tmp_path, 36, 64).scene
    assert len({content_hash(photograph.image) for photograph in scene.photographs}) == 20
    assert scene.photographs[0].lens.width == 64
