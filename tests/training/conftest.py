"""train.py as a user runs it, on tiny synthetic scenes."""

import os
import subprocess
import sys

import pytest

TINY = [
    *("width=0.125", "state_size=8", "model.layers=1m1s", "steps=4", "validate_every=2"),
    "trainer.log_every_n_steps=1",
    *("data.height=32", "data.width=32", "data.inputs=3", "data.targets=2", "data.num_workers=0"),
]
TINY_SCENES = [
    *("data.num_frames=24", "data.window=[12,24]"),
    *("data.val_scenes=1", "data.test_scenes=2"),
]


@pytest.fixture
def train(tmp_path, repository, monkeypatch):
    """Runs train.py with overrides; logs go below tmp_path."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def complete(*overrides):
        synthetic = not any(override.startswith("data=") for override in overrides)
        scenes = TINY_SCENES if synthetic else []
        tiny = [option for option in TINY if option.split("=")[0] not in str(overrides)]
        return [*overrides, f"paths.logs={tmp_path}", *scenes, *tiny]

    def run(*overrides):
        command = [sys.executable, "train.py", *complete(*overrides)]
        return subprocess.run(
            command, cwd=repository, env=environment, capture_output=True, text=True
        )

    run.complete = complete
    run.command = [sys.executable, "train.py", f"paths.logs={tmp_path}", *TINY, *TINY_SCENES]
    run.environment = environment
    return run
