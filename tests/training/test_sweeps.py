"""Sweeps: what is finished is not run again, a failure stops nothing else, launchers work."""

import json
import signal
import subprocess
import time

import pytest
from hydra import compose, initialize_config_dir

from asysplat.training.runs import describe_run

SWEEP = ["sweeps=layers", "model=asysplat_7m1s", "model.layers=1m1s", "steps=1"]


def finished_seeds(logs) -> list[int]:
    return sorted(json.loads(path.read_text())["run/seed"] for path in logs.rglob("metrics.json"))


def test_an_interrupted_sweep_runs_only_what_is_missing(train, repository, tmp_path):
    process = subprocess.Popen(
        [*train.command, *SWEEP, "seed=0,1,2"],
        cwd=repository,
        env=train.environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 300
    while not finished_seeds(tmp_path):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("metrics.json")}
    assert len(before) < 3

    result = train(*SWEEP, "seed=0,1,2")
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("finished already") == len(before)
    assert finished_seeds(tmp_path) == [0, 1, 2]
    assert {path: path.stat().st_mtime_ns for path in before} == before

    other = train(*SWEEP, "seed=2", "learning_rate=1e-4")
    assert "finished already" not in other.stdout
    assert finished_seeds(tmp_path) == [0, 1, 2, 2]


def test_what_another_revision_finished_is_told_and_run_again_where_asked(
    train, repository, tmp_path
):
    overrides = [*train.command[2:], *SWEEP]
    for seed, changes in enumerate(({"run/revision": "0123456789ab"}, {})):
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            config = compose("train", [*overrides, f"seed={seed}"])
        (tmp_path / str(seed)).mkdir()
        described = json.dumps(describe_run(config) | changes)
        (tmp_path / str(seed) / "metrics.json").write_text(described)

    result = train(*SWEEP, "seed=0,1")
    told = [line for line in result.stdout.splitlines() if "finished already" in line]
    assert told[0].startswith("job 0: finished already by 0123456789ab, while this is")
    assert told[1:] == ["job 1: finished already"]
    assert f"run: {tmp_path / '0'}" in result.stdout
    assert finished_seeds(tmp_path) == [0, 1]

    result = train(*SWEEP, "seed=0,1", "rerun=true")
    assert result.stdout.count("finished already") == 1
    assert finished_seeds(tmp_path) == [0, 0, 1]


def test_a_failure_is_named_and_the_others_go_on(train, tmp_path):
    result = train(*SWEEP, "seed=0", "data.height=40,32", "data.width=32")
    assert result.returncode != 0
    assert "failed: job 0" in result.stderr and "set 48x32" in result.stderr
    assert "Traceback" not in result.stderr
    assert finished_seeds(tmp_path) == [0]


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_launchers(train, tmp_path, launcher):
    plugin = launcher.partition("_")[0]
    pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher")
    overrides = [f"hydra/launcher={launcher}", "data.num_workers=1"]
    result = train(*SWEEP, "seed=0,1", *overrides)
    assert result.returncode == 0, result.stderr
    assert finished_seeds(tmp_path) == [0, 1]
    assert train(*SWEEP, "seed=0,1", *overrides).returncode == 0
    assert finished_seeds(tmp_path) == [0, 1]
