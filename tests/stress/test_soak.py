"""Long runs on real scenes, as they are, and with bounds checks in poisoned memory: make slow."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENES = ("fern", "fox", "mydesk", "hololens-000")
CHECKS = {"NUMBA_BOUNDSCHECK": "1"}
POISON = {"GLIBC_TUNABLES": "glibc.malloc.perturb=128"}

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]
both_ways = pytest.mark.parametrize("checked", [False, True], ids=["as it is", "checked"])


def run(command: list[str], cwd: Path, extra: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, *command],
        cwd=cwd,
        env={**os.environ, **extra},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.strip().splitlines()[-1]


@both_ways
@pytest.mark.parametrize("scene", SCENES)
def test_a_thousand_steps_of_all_fields(shared, repository, scene, checked):
    script = "tests/stress/soak.py"
    print(
        run([script, str(shared / "data" / scene), "1000"], repository, CHECKS if checked else {})
    )


@both_ways
def test_training_for_three_hundred_steps(shared, repository, tmp_path, checked):
    overrides = ["data=files", f"data.root={shared / 'data' / 'mydesk'}", "data.cache.folder=null"]
    command = ["train.py", *overrides, "steps=300", "validate_every=100", f"paths.logs={tmp_path}"]
    folder = run(command, repository, CHECKS | POISON if checked else {}).removeprefix("run: ")
    numbers = json.loads((Path(folder) / "metrics.json").read_text())
    assert numbers["test/files/psnr"] > numbers["baseline/files/mean_color/psnr"] + 1
