"""Every example runs as printed."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import nbformat
import pytest
from nbclient import NotebookClient
from tiny import NETWORK, VIEWS

from asysplat import read_gaussians
from asysplat.data import SceneOptions, open_scene


@pytest.fixture
def run_example(repository, monkeypatch):
    """Run examples/NAME.py with the words of a command line."""

    def run(name, *words):
        monkeypatch.setattr("sys.argv", [name, *map(str, words)])
        runpy.run_path(str(repository / "examples" / f"{name}.py"), run_name="__main__")

    return run


@pytest.mark.parametrize("name", ["render_scene", "predict_scene"])
def test_it_draws_a_figure(run_example, tmp_path, capsys, name):
    figure = tmp_path / f"{name}.png"
    run_example(name, figure)
    assert cv2.imread(str(figure)).std() > 20
    assert str(figure) in capsys.readouterr().out


@pytest.mark.slow  # the notebook does the same
def test_a_scene_is_reconstructed(run_example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run_example("reconstruct_scene")
    count = read_gaussians("reconstructed.ply").num_gaussians
    assert f"{count:,} Gaussians" in capsys.readouterr().out
    assert cv2.imread("reconstructed.png").std() > 20


@pytest.mark.medium
def test_the_notebook_runs_and_holds_no_outputs(repository, tmp_path):
    notebook = nbformat.read(repository / "examples" / "reconstruct_scene.ipynb", as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)
    # What it imports is this copy of the project.
    first = nbformat.v4.new_code_cell(f"import sys; sys.path.insert(0, {str(repository)!r})")
    notebook.cells.insert(0, first)
    NotebookClient(notebook, timeout=500, resources={"metadata": {"path": tmp_path}}).execute()
    kinds = [kind for cell in cells for out in cell.outputs for kind in out.get("data", ())]
    assert "image/png" in kinds
    scene = cells[-1].outputs[-1].text.strip()
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
def test_photographs_are_checked_and_trained_on(run_example, repository, tmp_path):
    scene = tmp_path / "my_scene"
    run_example("write_scene", scene)
    assert open_scene(scene, SceneOptions(64, 64)).num_images == 48
    tiny = [*NETWORK, *VIEWS, "steps=1", "validate_every=1", "data.cache.folder=null"]
    tiny += [f"paths.logs={tmp_path}/logs", "~callbacks.figures"]
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
