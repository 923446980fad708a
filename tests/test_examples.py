"""Every example runs as printed."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import nbformat
import pytest

from asysplat import read_gaussians, refine
from asysplat.data import SceneOptions, open_scene
from asysplat.overrides import check_overrides


@pytest.fixture
def run_example(repository, monkeypatch):
    """Run examples/NAME.py with the words of a command line."""

    def run(name, *words):
        monkeypatch.setattr("sys.argv", [name, *map(str, words)])
        monkeypatch.setattr("asysplat.interrupts.handle_signals", lambda: None)  # pytest's stay
        runpy.run_path(str(repository / "examples" / f"{name}.py"), run_name="__main__")

    return run


@pytest.mark.medium
@pytest.mark.parametrize("name", ["render_scene", "predict_scene"])
def test_it_draws_a_figure(run_example, tmp_path, capsys, name):
    figure = tmp_path / f"{name}.png"
    run_example(name, figure)
    assert cv2.imread(str(figure)).std() > 20
    assert str(figure) in capsys.readouterr().out


@pytest.fixture
def few_steps(monkeypatch):
    """A prediction in so many seconds takes a few steps."""
    monkeypatch.setattr(
        sys.modules["asysplat.refinement.predict"],
        "refine",
        lambda *given, seconds, **more: refine(*given, steps=5, **more),
    )


@pytest.mark.medium
def test_a_scene_is_reconstructed(run_example, few_steps, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run_example("reconstruct_scene")
    count = read_gaussians("reconstructed.ply").num_gaussians
    assert f"{count:,} Gaussians" in capsys.readouterr().out
    assert cv2.imread("reconstructed.png").std() > 20


@pytest.mark.medium
def test_the_blocks_of_the_readme_run(repository, few_steps, run_example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_example("write_scene", "my_scene")
    blocks = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(), re.DOTALL)
    names = {}
    for block in blocks:
        exec(block, names)
    assert read_gaussians("scene.ply").num_gaussians > 1000
    assert names["picture"].shape == (3, 64, 64)


@pytest.fixture
def notebook(repository):
    return nbformat.read(repository / "examples" / "reconstruct_scene.ipynb", as_version=4)


@pytest.mark.medium
def test_the_notebook_holds_no_outputs_and_its_code_runs(notebook, few_steps, capsys):
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)
    names = {}
    for cell in cells:
        exec(cell.source.replace("%matplotlib inline", ""), names)
    scene = capsys.readouterr().out.strip().splitlines()[-1]
    assert read_gaussians(scene).num_gaussians > 1000


@pytest.mark.medium
def test_names_that_bring_much_along_are_imported_when_asked_for(repository):
    heavy = ["lightning", "hydra", "cv2", "matplotlib", "pycolmap"]
    program = (
        "import asysplat, json, sys\n"
        f"before = [name for name in {heavy} if name in sys.modules]\n"
        "found = [getattr(asysplat, name).__name__ for name in asysplat.LATER]\n"
        "print(json.dumps([before, sorted(found), sorted(asysplat.LATER)]))"
    )
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, cwd=repository, capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    before, found, names = json.loads(said.stdout)
    assert before == [] and found == names


@pytest.mark.medium
def test_the_commands_for_photographs_are_those_of_the_scripts(repository, tmp_path, run_example):
    """A program in Python's place prints its words."""
    folder, written_scene = tmp_path, tmp_path / "my_scene"
    run_example("write_scene", written_scene)
    assert open_scene(written_scene, SceneOptions(64, 64)).num_images == 48
    (folder / "python").write_text('#!/bin/sh\necho "$@"\n')
    (folder / "python").chmod(0o755)
    done = subprocess.run(
        ["bash", repository / "examples" / "train_on_photographs.sh", written_scene, "steps=1"],
        env={**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    check, train = (line.split() for line in done.stdout.splitlines())
    assert check == ["-m", "asysplat.data.check", str(written_scene)]
    assert Path(train[0]).samefile(repository / "train.py") and train[-1] == "steps=1"
    assert f"data.root={written_scene}" in train
    check_overrides(train[1:])
