"""Several scenes by one command."""

import os
import shutil
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.reconstruct.scenes import reconstruct_scenes

TINY = ["height=32", "steps=4", "views=6", "refinement.max_gaussians=500", "video.path=none"]
TINY += ["paths.weights=none", "cameras=given", "held_out_every=4"]


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["one/a", "two/a"], "2 of the scenes are named a"),
        (["one/a", "absent"], "absent does not exist"),
    ],
)
def test_mistakes_are_named_before_any_work(tmp_path, monkeypatch, paths, message):
    for name in ("one/a", "two/a"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    config = OmegaConf.create({"paths": {"logs": "logs"}, "jobs": 1})
    with pytest.raises(InputError, match=message):
        reconstruct_scenes(paths, [], config)
    assert not (tmp_path / "logs").exists()


@pytest.mark.medium
def test_one_that_fails_does_not_stop_the_others_and_finished_ones_are_skipped(
    repository, tmp_path
):
    shelf = tmp_path / "it's a shelf"
    scene = ProceduralScene(seed=7, height=32, width=32, num_images=8)
    write_transforms(scene.views(range(8)), shelf / "cup")
    shutil.copytree(shelf / "cup", shelf / "jug")
    (shelf / "mug").mkdir()
    paths = [f"{shelf / name}/" for name in ("cup", "jug", "mug")]
    words = [*paths, *TINY, "jobs=2", f"paths.logs={tmp_path / 'logs'}"]

    def run():
        command = [sys.executable, str(repository / "reconstruct.py"), *words]
        return subprocess.run(command, capture_output=True, text=True, cwd=repository)

    said = run()
    assert said.returncode == 1 and said.stderr == "", said.stderr
    assert "mug: error: " in said.stdout and said.stdout.count("dB held out") == 2
    root = tmp_path / "logs" / "scenes"
    assert {file.parts[-3] for file in root.glob("*/run/scene.ply")} == {"cup", "jug"}
    page = (root / "reconstructions.html").read_text()
    assert "cup/run/scene.html" in page and "jug/run" in page and "mug" not in page
    write_transforms(scene.views(range(8)), shelf / "mug")
    before = os.stat(root / "cup" / "run" / "metrics.json").st_mtime_ns
    said = run()
    assert said.returncode == 0 and said.stdout.count("skipped") == 2, said.stdout
    assert os.stat(root / "cup" / "run" / "metrics.json").st_mtime_ns == before
    assert "mug/run/scene.html" in (root / "reconstructions.html").read_text()
