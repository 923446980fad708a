"""The examples in the docstrings of what `asysplat` exports run as printed."""

import doctest

import pytest

import asysplat
from asysplat import write_gaussians
from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms
from benchmarks.scenes import random_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the photographs and the scene that the examples name."""
    folder = tmp_path_factory.mktemp("user")
    write_transforms(ProceduralScene(0, 64, 64, 12).views(range(12)), folder / "my_scene")
    write_gaussians(folder / "scene.ply", random_scene(1000, 8, 8)[0])
    return folder


@pytest.mark.medium
@pytest.mark.parametrize("name", asysplat.LATER)
def test_an_example_runs_and_prints_what_it_says(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    # Of a class its own docstring alone.
    (test,) = (
        found
        for found in doctest.DocTestFinder(recurse=False).find(getattr(asysplat, name), name)
        if found.name == name
    )
    assert test.examples
    test.globs = {}
    printed = []
    runner = doctest.DocTestRunner(verbose=False)
    runner.run(test, out=printed.append)
    assert runner.failures == 0, "".join(printed)
