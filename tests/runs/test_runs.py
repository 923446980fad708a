"""Which options, files and data make two runs, or two evaluations, different."""

import json
import subprocess

import pytest

from asysplat.runs import machine as revisions
from asysplat.runs.evaluation_target import find_target
from asysplat.runs.runs import (
    RECONSTRUCTION,
    config_hash,
    data_of,
    describe_run,
    find_reconstructions,
    find_run,
    find_runs,
)

DL3DV = ["data=dl3dv", "data.root=/a/DL3DV", "data.test_root=/a/Benchmark"]


def test_a_reconstruction_with_or_without_a_scene_is_no_trained_run(tmp_path, recwarn):
    for name, files in {"a": RECONSTRUCTION, "b": RECONSTRUCTION[:2]}.items():
        (tmp_path / name).mkdir()
        for file in ("metrics.json", *files):
            (tmp_path / name / file).write_text("{}")
    assert list(find_runs(tmp_path)) == [] and not recwarn.list
    assert find_reconstructions(tmp_path) == [tmp_path / "a"]  # from whose scene run=last goes on


@pytest.fixture
def write_run(tmp_path):
    def write(name, config, **changes):
        folder = tmp_path / name
        folder.mkdir()
        described = {key.replace("__", "/"): value for key, value in changes.items()}
        (folder / "metrics.json").write_text(json.dumps(describe_run(config) | described))
        return folder

    return write


SAME = [
    *("metrics=default", "seed=5", "logger=none", "name=other", "paths.logs=/b/logs", "rerun=true"),
    *("data.root=/b/DL3DV", "data.test_root=/b/c/Benchmark/"),
    *(
        "data.num_workers=3",
        "paths.weights=/b/weights",
        "training.loss.perceptual_term.backbone_dir=/c",
    ),
    *("test_sets=[mipnerf360]", "paths.mipnerf360=/b/360_v2", "callbacks.figures.scenes=0"),
    *("trainer=ddp", "trainer.devices=4", "trainer.num_nodes=2"),
    *("data.micro_batch=1", "training.checkpoint_layers=true"),
    "replica_size.width=96",  # of a test that is not made
]
OTHER = {
    "selection": ["data.selection=uniform"],
    "targets": ["data.targets=3"],
    "size": ["data.height=96"],
    "model": ["model=asysplat_7m1t"],
    "steps": ["steps=241"],
    "metrics": ["metrics=longlrm"],
    "depth alignment": ["metrics.depth_alignment=median"],
    "weights to start from": ["init_path=/b/last.ckpt"],
    "frames instead of scenes": ["data.test_root=null"],
}


def test_options_that_change_no_number_keep_the_hash(composed):
    plain, changed = composed(*DL3DV), composed(*DL3DV, *SAME)
    assert config_hash(changed) == config_hash(plain)
    described = {key: value for key, value in data_of(changed).items() if "test_sets" not in key}
    assert described == data_of(plain)


@pytest.mark.medium
@pytest.mark.parametrize("case", OTHER)
def test_options_that_change_numbers_change_the_hash(composed, case):
    assert config_hash(composed(*DL3DV, *OTHER[case])) != config_hash(composed(*DL3DV))


def test_paths_may_be_left_out(composed):
    assert config_hash(composed("data=dl3dv")) == config_hash(composed(*DL3DV))
    assert data_of(composed("data=dl3dv")) == {}
    assert data_of(composed(*DL3DV)) == {
        "run/data/root": "DL3DV",
        "run/data/test_root": "Benchmark",
    }


@pytest.mark.medium
def test_runs_of_other_data_differ(composed, write_run, tmp_path):
    overrides = ["data=files", "data.root=/a/garden"]
    folder = write_run("one", composed(*overrides))
    assert find_run(tmp_path, composed(*overrides)).folder == folder
    assert find_run(tmp_path, composed("data=files", "data.root=/b/garden")).folder == folder
    assert find_run(tmp_path, composed("data=files", "data.root=/a/bicycle")) is None


@pytest.mark.medium
@pytest.mark.parametrize("option", ["data.index", "init_path"])
def test_files_are_compared_by_content(composed, write_run, tmp_path, option):
    paths = [tmp_path / f"{number}.json" for number in range(3)]
    for path, text in zip(paths, ("[1]", "[1]", "[2]"), strict=True):
        path.write_text(text)
    overrides = ["data=realestate10k", "data.root=/a/train", "data.test_root=/a/test"]
    overrides += ["data.selection=index"] * (option == "data.index")
    first, moved, other = (composed(*overrides, f"{option}={path}") for path in paths)
    write_run("run", first)
    assert find_run(tmp_path, moved) is not None
    assert find_run(tmp_path, other) is None


@pytest.mark.medium
def test_a_run_with_more_test_sets_is_found_for_fewer(composed, write_run, tmp_path):
    tested = [*DL3DV, "test_sets=[mipnerf360,replica]", "paths.replica=/a/Replica"]
    folder = write_run("run", composed(*tested))
    assert find_run(tmp_path, composed(*DL3DV)).folder == folder
    assert find_run(tmp_path, composed(*tested)).folder == folder
    assert find_run(tmp_path, composed(*tested, "paths.mipnerf360=/a/360_v2")) is None
    width = "data.test_sets.replica.width=128"
    assert find_run(tmp_path, composed(*tested, width)) is None
    assert find_run(tmp_path, composed(*tested, "replica_size.width=128")) is None


def test_the_run_of_this_revision_comes_first(composed, write_run, tmp_path):
    config = composed()
    write_run("a", config)
    write_run("b", config, run__revision="0123456")
    assert [run.folder.name for run in find_runs(tmp_path)] == ["a", "b"]
    assert find_run(tmp_path, config).folder.name == "a"
    write_run("c", config)
    assert find_run(tmp_path, config).folder.name == "c"


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository with one commit, in the place of this one."""

    def git(*arguments):
        name = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *name, *arguments], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    (tmp_path / "train.py").write_text("1")
    (tmp_path / "README.md").write_text("1")
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "train.yaml").write_text("steps: 1")
    git("add", ".")
    git("commit", "-m", "first")
    monkeypatch.setattr(revisions, "ROOT", tmp_path)
    return tmp_path


def fresh() -> str:
    revisions.revision.cache_clear()
    value = revisions.revision()
    revisions.revision.cache_clear()
    return value


def test_a_revision_is_a_commit_and_its_changes(checkout):
    commit = fresh()
    assert len(commit) == 12 and "+" not in commit
    (checkout / "README.md").write_text("2")
    assert fresh() == commit
    (checkout / "train.py").write_text("2")
    changed = fresh()
    assert changed.startswith(f"{commit}+")
    (checkout / "train.py").write_text("3")
    assert fresh().startswith(f"{commit}+") and fresh() != changed
    (checkout / "train.py").write_text("1")
    assert fresh() == commit


def test_without_a_repository_of_its_own_a_package_has_a_version(checkout, monkeypatch):
    (checkout / "site-packages").mkdir()
    monkeypatch.setattr(revisions, "ROOT", checkout / "site-packages")
    assert fresh() in (f"version {revisions.__version__}", "unknown")


GARDEN = ["data=files", "data.root=/a/garden"]


@pytest.fixture
def scene_folder(composed, tmp_path):
    """A function that returns the folder of the scenes' results of a command."""

    def find(*overrides):
        paths = [f"paths.logs={tmp_path}", "paths.run=unused"]
        return find_target(composed(*overrides, *paths, script="evaluate"), overrides).scene_folder

    return find


@pytest.fixture
def files(tmp_path):
    """Two files of the same content and one of another."""
    paths = [tmp_path / name for name in ("a.ckpt", "elsewhere.ckpt", "other.ckpt")]
    for path, content in zip(paths, (b"1", b"1", b"2"), strict=True):
        path.write_bytes(content)
    return paths


@pytest.mark.medium
def test_weights_are_compared_by_content(scene_folder, files):
    same, moved, other = (scene_folder(f"init_path={path}", *GARDEN) for path in files)
    assert moved.name == same.name and other.name != same.name
    assert same.parents[1].name == f"a-{same.name[:8]}"


OTHER_EVALUATION = {
    "steps": [*GARDEN, "post_optimization_steps=[0,3]"],
    "data": ["data=files", "data.root=/a/bicycle"],
    "frames": [*GARDEN, "data.inputs=16"],
    "protocol": [*GARDEN, "metrics=longlrm"],
    "seed": [*GARDEN, "seed=1"],
    "test sets": [*GARDEN, "test_sets=[mipnerf360]", "paths.mipnerf360=/a/360"],
}


@pytest.mark.medium
@pytest.mark.parametrize("case", OTHER_EVALUATION)
def test_other_options_are_another_evaluation(scene_folder, files, case):
    weights = f"init_path={files[0]}"
    first = scene_folder(weights, *GARDEN)
    assert scene_folder(weights, *GARDEN, "data.num_workers=3", "paths.weights=/b") == first
    assert scene_folder(weights, *OTHER_EVALUATION[case]) != first


def test_another_revision_of_the_code_is_another_evaluation(scene_folder, files, monkeypatch):
    command = (f"init_path={files[0]}", *GARDEN)
    first = scene_folder(*command)
    monkeypatch.setattr("asysplat.runs.runs.revision", lambda: "other")
    assert scene_folder(*command) != first
