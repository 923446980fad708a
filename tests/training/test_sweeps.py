"""Sweeps: finished runs are not repeated, failures do not stop other jobs, launchers work."""

import json
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from asysplat.runs.runs import describe_run

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


@pytest.fixture(autouse=True)
def at_exit(monkeypatch, capsys):
    """What the process of the last sweep prints at its end."""
    calls = []
    register = SimpleNamespace(register=lambda *call: calls.append(call))
    monkeypatch.setattr("asysplat.training.sweep_table.atexit", register)

    def printed() -> str:
        capsys.readouterr()
        function, *arguments = calls[-1]
        function(*arguments)
        return capsys.readouterr().out

    return printed


@pytest.fixture
def table_rows(at_exit):
    """The cells of each line of the table that it prints."""

    def rows() -> list[list[str]]:
        lines = [line for line in at_exit().splitlines() if "│" in line]
        return [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines]

    return rows


def test_a_sweep_runs_only_what_is_missing_and_ends_with_a_table(
    train, finish, tmp_path, at_exit, table_rows
):
    finish(0, revision="0123456789ab")
    finish(1)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("metrics.json")}
    result = train(*SWEEP, "seed=0,1,2")
    lines = [line for line in result.stdout.splitlines() if "finished already" in line]
    assert lines[0].startswith("job 0: finished already by 0123456789ab, while this is")
    assert lines[1:] == ["job 1: finished already"]
    assert f"run: {tmp_path / '0'}" in result.stdout
    assert finished_seeds(tmp_path) == [0, 1, 2]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    rows = table_rows()
    assert [row[0] for row in rows[:3]] == ["0", "1", "2"] and rows[2][3] != ""
    assert not any("not" in row for row in rows) and "not finished" not in at_exit()

    result = train(*SWEEP, "seed=0,1", "rerun=true")  # of another revision
    assert result.stdout.count("finished already") == 1
    assert finished_seeds(tmp_path) == [0, 0, 1, 2]
    other = train(*SWEEP, "seed=2", "learning_rate=1e-4")
    assert "finished already" not in other.stdout


def test_a_failure_is_named_and_the_others_go_on(train, tmp_path, table_rows):
    result = train(*SWEEP, "seed=0", "data.height=40,32", "data.width=32")
    assert result.returncode != 0
    assert "failed: job 0" in result.stderr and "set 48x32" in result.stderr
    assert "Traceback" not in result.stderr
    assert finished_seeds(tmp_path) == [0]
    (failed,) = [row for row in table_rows() if row[0] == "40"]
    assert failed[1] == "not"  # finished
    (folder,) = tmp_path.rglob("metrics.json")
    assert folder.parent.name == "1_data.height=32"


def test_an_interrupted_sweep_prints_how_to_resume(train, monkeypatch, at_exit):
    place = "asysplat.training.module.SplattingModule.compute_terms"
    monkeypatch.setattr(place, Mock(side_effect=KeyboardInterrupt))
    result = train(*SWEEP, "seed=0,1")
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert "stopped." in (result.stdout + result.stderr).splitlines()
    assert "ckpt_path" not in result.stdout
    assert "the same command skips the jobs that are" in at_exit()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_launcher_runs_the_missing_jobs(train, finish, tmp_path, launcher):
    plugin = launcher.partition("_")[0]
    pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher")
    finish(2)
    before = (tmp_path / "2" / "metrics.json").stat().st_mtime_ns
    result = train.alone(*SWEEP, "seed=0,1,2", f"hydra/launcher={launcher}", "data.num_workers=1")
    assert result.returncode == 0, result.stderr
    assert finished_seeds(tmp_path) == [0, 1, 2]
    assert (tmp_path / "2" / "metrics.json").stat().st_mtime_ns == before
