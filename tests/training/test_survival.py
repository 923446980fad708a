"""Killed or stopped runs resume with the same bits; other ends are one sentence."""

import csv
import os
import random
import re
import signal
import time
from pathlib import Path

import events
import processes
import pytest
import torch
from full_disk import largest_file

from asysplat.training.checkpoints import read_notes

OPTIONS = ["callbacks.checkpoints.minutes=0", "data.num_workers=1", "data.batch_size=2"]


def folder_of(train, name) -> Path:
    """The one folder of all processes of a run."""
    (folder,) = (train.logs / name).iterdir()
    return folder


def wait_for(found, process, seconds=300):
    """Wait until `found()`, or the end of the process."""
    end = time.monotonic() + seconds
    while process.is_alive() and not found():
        assert time.monotonic() < end
        time.sleep(0.005)


def start_or_resume(train, name, *overrides):
    """Start a run, or resume it if an earlier process has left a checkpoint."""
    checkpoints = list(train.logs.glob(f"{name}/*/checkpoints/*.ckpt"))
    resume = ["ckpt_path=last"] if checkpoints else []
    output = train.logs / f"{name}.txt"
    if not checkpoints:  # the earlier process was too short to write one
        for folder in train.logs.glob(f"{name}/*"):
            folder.rename(train.logs / f"{name}-{folder.name}")
    return processes.start(output, *train.complete(f"name={name}", *overrides, *resume)), output


def kill_at_random_moments(train, kills, longest, *overrides):
    """Kill a run at random moments, up to `longest` seconds after it has built its model."""
    moments = random.Random(0)
    killed = 0
    for _ in range(kills):
        output = train.logs / "killed.txt"
        before = output.read_text().count("model: ") if output.exists() else 0
        process, output = start_or_resume(train, "killed", *overrides)
        wait_for(lambda: output.exists() and output.read_text().count("model: ") > before, process)  # noqa: B023
        time.sleep(moments.uniform(0, longest))
        killed += process.is_alive()
        process.kill()
        process.join()
    process, output = start_or_resume(train, "killed", *overrides)
    process.join()
    assert process.exitcode == 0, output.read_text()
    return killed


def last_weights(folder):
    path = folder / "checkpoints" / "last.ckpt"
    return torch.load(path, weights_only=True)["state_dict"]


def rows(path):
    with path.open() as file:
        return [
            {key: value for key, value in row.items() if key != "minutes"}
            for row in csv.DictReader(file)
        ]


def check_same(whole, killed):
    weights, survived = last_weights(whole), last_weights(killed)
    assert weights.keys() == survived.keys()
    assert [name for name in weights if not torch.equal(weights[name], survived[name])] == []
    for name in ("curve.csv", "metrics.csv"):
        assert rows(whole / name) == rows(killed / name) != []
    assert events.scalars(whole) == events.scalars(killed) != {}
    for kind in ("scalars", "images", "tensors"):
        assert events.steps(whole, kind) == events.steps(killed, kind) != {}
    assert (killed / "checkpoints" / "previous.ckpt").exists()


@pytest.mark.medium
def test_killed_twice_it_ends_with_the_same_bits_and_logs(train):
    options = [*OPTIONS, "steps=6", "validate_every=3"]
    result = train("name=whole", *options)
    assert result.returncode == 0, result.stderr
    assert kill_at_random_moments(train, 2, 3, *options) > 0
    whole = folder_of(train, "whole")
    check_same(whole, folder_of(train, "killed"))

    before = events.scalars(whole)
    (whole / "metrics.json").unlink()  # as if killed after its training, while it is measured
    result = train("name=whole", *options, "ckpt_path=last")
    assert result.returncode == 0, result.stderr
    assert events.scalars(whole) == before
    check_same(whole, folder_of(train, "killed"))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_twenty_times_it_ends_with_the_same_bits_and_logs(train):
    options = [*OPTIONS, "steps=150", "validate_every=10"]
    result = train("name=whole", *options)
    assert result.returncode == 0, result.stderr
    killed = kill_at_random_moments(train, 20, 6, *options)
    print(f"killed {killed} times")
    assert killed == 20
    check_same(folder_of(train, "whole"), folder_of(train, "killed"))


@pytest.mark.medium
def test_a_signal_to_all_processes_and_then_a_lost_loader(train):
    options = [*OPTIONS, "steps=1000", "validate_every=1000"]
    process, output = start_or_resume(train, "noticed", *options)
    wait_for(lambda: list(train.logs.glob("noticed/*/checkpoints/previous.ckpt")), process)
    os.killpg(process.pid, signal.SIGTERM)
    process.join()
    text = output.read_text()
    assert process.exitcode == 128 + signal.SIGTERM, text
    saved = int(re.search(r"SIGTERM: saved at step (\d+)", text)[1])
    last = folder_of(train, "noticed") / "checkpoints" / "last.ckpt"
    assert read_notes(last)["global_step"] == saved >= 2
    assert f"stopped; to go on, add ckpt_path={last} to the same command" in text

    before = last.stat().st_mtime
    process, output = start_or_resume(train, "noticed", *options)
    wait_for(lambda: last.exists() and last.stat().st_mtime > before, process)
    kill_workers(process)
    process.join()
    text = output.read_text()
    assert process.exitcode == 1, text
    assert f"resuming from {last}" in text and text.count("stopped; to go on") == 2
    assert "error: a process that loads data was lost (DataLoader worker (pid" in text
    assert "Traceback" not in text


def kill_workers(process):
    """Kill the processes that load data."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert children
    for worker in children:
        os.kill(int(worker), signal.SIGKILL)


@pytest.mark.medium
def test_a_full_disk_ends_a_run_with_a_sentence(train):
    with largest_file(5_000_000):  # which the checkpoint exceeds
        result = train("name=full", "steps=2")
    assert result.returncode == 1
    assert "best.ckpt cannot be written (File too large): name a folder" in result.stderr
    assert "Traceback" not in result.stderr
    assert list(folder_of(train, "full").rglob("*.ckpt")) == []
