"""Every example runs as printed."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from tiny import NETWORK, VIEWS

from asysplat.data import open_scene


@pytest.mark.parametrize("name", ["render_scene", "predict_scene"])
def test_it_draws_a_picture(repository, tmp_path, monkeypatch, capsys, name):
    picture = tmp_path / f"{name}.png"
    monkeypatch.setattr("sys.argv", [name, str(picture)])
    runpy.run_path(str(repository / "examples" / f"{name}.py"), run_name="__main__")
    assert cv2.imread(str(picture)).std() > 20
    assert str(picture) in capsys.readouterr().out


@pytest.mark.slow
def test_photographs_are_checked_and_trained_on(repository, tmp_path, monkeypatch):
    scene = tmp_path / "my_scene"
    monkeypatch.setattr("sys.argv", ["write_scene", str(scene)])
    runpy.run_path(str(repository / "examples" / "write_scene.py"), run_name="__main__")
    assert open_scene(scene, 64, 64).num_frames == 48
    tiny = [*NETWORK, *VIEWS, "steps=1", "validate_every=1", "data.cache.folder=null"]
    tiny += [f"paths.logs={tmp_path}/logs", "~callbacks.pictures"]
    said = subprocess.run(
        ["bash", repository / "examples" / "train_on_photographs.sh", scene, *tiny],
        env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert said.returncode == 0, said.stderr
    assert "The cameras fit the images." in said.stdout
    assert len(list(tmp_path.glob("logs/photographs/*/metrics.json"))) == 1
