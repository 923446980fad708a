"""Fixtures that run train.py as a user does, on tiny synthetic scenes."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from tiny import NETWORK, SCENES, STEPS, VIEWS

COSTS = "callbacks.costs={_target_: asysplat.training.callbacks.Costs}"
# They take longer than the steps of most tests: COSTS turns costs and plan on, UNTRAINED the
# validation before the first step.
UNTRAINED = "trainer.num_sanity_val_steps=-1"
TINY = [*NETWORK, *STEPS, *VIEWS, "callbacks.costs=null", "trainer.num_sanity_val_steps=0"]
TINY_SCENES = [*SCENES, "data.test_scenes=2"]


def finished(result: subprocess.CompletedProcess) -> Path:
    """The folder of a finished run, which the script prints last."""
    assert result.returncode == 0, result.stderr
    label, folder = result.stdout.strip().splitlines()[-1].split(": ", 1)
    assert label == "run"
    return Path(folder)


@pytest.fixture
def train(tmp_path, run_script, repository):
    """A function that runs train.py with overrides and logs below tmp_path."""
    return make_train(tmp_path, run_script, repository)


@pytest.fixture(scope="module")
def module_train(tmp_path_factory, run_script, repository):
    """The same for the runs that several tests share."""
    return make_train(tmp_path_factory.mktemp("logs"), run_script, repository)


@pytest.fixture(scope="session")
def whole(tmp_path_factory, run_script, repository) -> Path:
    """The folder of a finished run of 6 steps."""
    train = make_train(tmp_path_factory.mktemp("logs"), run_script, repository)
    return finished(train("name=whole", "steps=6", "callbacks.monitor.every=2", COSTS, UNTRAINED))


def make_train(logs, run_script, repository):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def complete(*overrides):
        synthetic = not any(override.startswith("data=") for override in overrides)
        scenes = TINY_SCENES if synthetic else []
        given = {override.lstrip("~+").split("=")[0] for override in overrides}
        tiny = [option for option in (*TINY, *scenes) if option.split("=")[0] not in given]
        return [*overrides, f"paths.logs={logs}", *tiny]

    def run(*overrides):
        """In this process, which has imported everything."""
        return run_script("train.py", *complete(*overrides))

    def run_alone(*overrides):
        """In an interpreter of its own, as a user does."""
        command = [sys.executable, "train.py", *complete(*overrides)]
        return subprocess.run(
            command, cwd=repository, env=environment, capture_output=True, text=True
        )

    @contextmanager
    def start(*overrides, until):
        """Yield a process when the logs have a file named `until`; kill it at the end.

        It handles SIGINT, even if the shell ignores it for background jobs.
        """
        process = subprocess.Popen(
            [sys.executable, "train.py", *complete(*overrides)],
            cwd=repository,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        deadline = time.monotonic() + 300
        try:
            while not list(logs.rglob(until)):
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.01)
            yield process
        finally:
            process.kill()
            process.communicate()

    run.alone, run.start, run.complete, run.logs = run_alone, start, complete, logs
    return run
