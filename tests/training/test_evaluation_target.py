"""Which options and files make another evaluation."""

import pytest
from hydra import compose, initialize_config_dir

from asysplat.training.evaluation_target import find_target

DATA = ["data=files", "data.root=/a/garden"]


@pytest.fixture
def scene_folder(repository, tmp_path):
    """A function that returns the folder of the scenes' results of a command."""

    def find(*overrides):
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            paths = [f"paths.logs={tmp_path}", "paths.run=unused"]
            options = compose("evaluate", [*overrides, *paths])
        return find_target(options, overrides).scene_folder

    return find


@pytest.fixture
def files(tmp_path):
    """Two files of the same content and one of another."""
    paths = [tmp_path / name for name in ("a.ckpt", "elsewhere.ckpt", "other.ckpt")]
    for path, content in zip(paths, (b"1", b"1", b"2"), strict=True):
        path.write_bytes(content)
    return paths


@pytest.mark.parametrize("option", ["init_path", "scene"])
def test_files_are_compared_by_content(scene_folder, files, option):
    same, moved, other = (scene_folder(f"{option}={path}", *DATA) for path in files)
    assert moved.name == same.name and other.name != same.name
    assert same.parents[1].name == f"a-{same.name[:8]}"


OTHER = {
    "steps": [*DATA, "steps=[0,3]"],
    "data": ["data=files", "data.root=/a/bicycle"],
    "frames": [*DATA, "data.inputs=16"],
    "protocol": [*DATA, "metrics=longlrm"],
    "seed": [*DATA, "seed=1"],
    "test sets": [*DATA, "test_sets=[mipnerf360]", "paths.mipnerf360=/a/360"],
}


@pytest.mark.parametrize("case", OTHER)
def test_other_options_are_another_evaluation(scene_folder, files, case):
    weights = f"init_path={files[0]}"
    first = scene_folder(weights, *DATA)
    assert scene_folder(weights, *DATA, "data.cache.folder=null", "paths.weights=/b") == first
    assert scene_folder(weights, *OTHER[case]) != first


def test_another_revision_of_the_code_is_another_evaluation(scene_folder, files, monkeypatch):
    command = (f"init_path={files[0]}", *DATA)
    first = scene_folder(*command)
    monkeypatch.setattr("asysplat.training.runs.revision", lambda: "other")
    assert scene_folder(*command) != first
