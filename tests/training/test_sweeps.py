"""Sweeps: finished runs are not repeated, failures do not stop other jobs, launchers work."""

import json
import signal

import pytest

from asysplat.training.runs import describe_run

pytestmark = pytest.mark.medium

SWEEP = ["sweeps=layers", "model=asysplat_7m1s", "model.layers=1m1s", "steps=1"]
SWEEP += ["data.test_sets=null", "callbacks.figures=null"]


def finished_seeds(logs) -> list[int]:
    return sorted(json.loads(path.read_text())["run/seed"] for path in logs.rglob("metrics.json"))


@pytest.fixture
def finish(train, composed, tmp_path):
    """Leaves behind what a finished run does, without running it."""

    def write(seed, **changes):
        config = composed(*train.complete(*SWEEP), f"seed={seed}")
        (tmp_path / str(seed)).mkdir()
        described = describe_run(config) | {f"run/{key}": value for key, value in changes.items()}
        (tmp_path / str(seed) / "metrics.json").write_text(json.dumps(described))

    return write


def test_an_interrupted_sweep_runs_only_what_is_missing(train, tmp_path):
    with train.start(*SWEEP, "seed=0,1,2", until="metrics.json") as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("metrics.json")}
    assert len(before) < 3

    result = train.alone(*SWEEP, "seed=0,1,2")
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("finished already") == len(before)
    table = result.stdout.rpartition("test scenes: procedural")[2]
    cells = [row.split("│")[1].strip() for row in table.splitlines() if "│" in row]
    assert cells[:3] == ["0", "1", "2"] and "not finished" not in table
    assert finished_seeds(tmp_path) == [0, 1, 2]
    assert {path: path.stat().st_mtime_ns for path in before} == before

    other = train(*SWEEP, "seed=2", "learning_rate=1e-4")
    assert "finished already" not in other.stdout
    assert finished_seeds(tmp_path) == [0, 1, 2, 2]


def test_a_run_of_another_revision_is_named_and_repeated_with_rerun(train, finish, tmp_path):
    finish(0, revision="0123456789ab")
    finish(1)
    result = train(*SWEEP, "seed=0,1")
    lines = [line for line in result.stdout.splitlines() if "finished already" in line]
    assert lines[0].startswith("job 0: finished already by 0123456789ab, while this is")
    assert lines[1:] == ["job 1: finished already"]
    assert f"run: {tmp_path / '0'}" in result.stdout
    assert finished_seeds(tmp_path) == [0, 1]

    result = train(*SWEEP, "seed=0,1", "rerun=true")
    assert result.stdout.count("finished already") == 1
    assert finished_seeds(tmp_path) == [0, 0, 1]


def test_a_failure_is_named_and_the_others_go_on(train, tmp_path):
    result = train.alone(*SWEEP, "seed=0", "data.height=40,32", "data.width=32")
    assert result.returncode != 0
    assert "failed: job 0" in result.stderr and "set 48x32" in result.stderr
    assert "Traceback" not in result.stderr
    assert finished_seeds(tmp_path) == [0]
    rows = [row.split("│") for row in result.stdout.splitlines() if "│" in row]
    (failed,) = [row for row in rows if row[1].strip() == "40"]
    assert failed[2].strip() == "not"  # finished
    (folder,) = tmp_path.rglob("metrics.json")
    assert folder.parent.name == "1_data.height=32"


@pytest.mark.parametrize(
    "launcher", [pytest.param("joblib", marks=pytest.mark.slow), "submitit_local"]
)
def test_launchers(train, finish, tmp_path, launcher):
    """Two of three jobs are still to be run."""
    plugin = launcher.partition("_")[0]
    pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher")
    finish(2)
    before = (tmp_path / "2" / "metrics.json").stat().st_mtime_ns
    result = train.alone(*SWEEP, "seed=0,1,2", f"hydra/launcher={launcher}", "data.num_workers=1")
    assert result.returncode == 0, result.stderr
    assert finished_seeds(tmp_path) == [0, 1, 2]
    assert (tmp_path / "2" / "metrics.json").stat().st_mtime_ns == before
