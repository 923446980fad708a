"""Killed or stopped runs resume with the same bits; other ends are one sentence."""

import csv
import os
import random
import re
import signal
import time
from contextlib import suppress
from pathlib import Path

import events
import processes
import pytest
import torch
from tiny_runs import finished

from asysplat.runs.checkpoints import read_metadata

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
    # Not best.ckpt, nor one that was being written: a run resumes from neither.
    names = ("last.ckpt", "previous.ckpt")
    checkpoints = [p for each in names for p in train.logs.glob(f"{name}/*/checkpoints/{each}")]
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


def rows(path):
    with path.open() as file:
        return [row | {"minutes": None} for row in csv.DictReader(file)]


def load_weights(folder):
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def check_same(whole, killed):
    weights, survived = load_weights(whole), load_weights(killed)
    assert weights.keys() == survived.keys()
    assert [name for name in weights if not torch.equal(weights[name], survived[name])] == []
    for name in ("curve.csv", "metrics.csv"):
        assert rows(whole / name) == rows(killed / name) != []
    assert events.scalars(whole) == events.scalars(killed) != {}
    for kind in ("scalars", "images", "histograms"):
        assert events.steps(whole, kind) == events.steps(killed, kind) != {}
    assert (killed / "checkpoints" / "previous.ckpt").exists()


SLOW = (pytest.mark.slow, pytest.mark.timeout(3600))


@pytest.mark.parametrize(
    ("kills", "longest", "steps", "validate_every"),
    [pytest.param(1, 2, 4, 2, marks=pytest.mark.medium), pytest.param(20, 6, 150, 10, marks=SLOW)],
)
def test_a_killed_run_ends_with_the_same_bits_and_logs(
    train, kills, longest, steps, validate_every
):
    options = [*OPTIONS, f"steps={steps}", f"validate_every={validate_every}"]
    whole = finished(train("name=whole", *options))
    killed = kill_at_random_moments(train, kills, longest, *options)
    print(f"killed {killed} times")
    assert killed == kills if kills == 20 else killed > 0
    check_same(whole, folder_of(train, "killed"))

    before = events.scalars(whole)
    (whole / "metrics.json").unlink()  # as if killed after its training, while it is measured
    finished(train("name=whole", *options, "ckpt_path=last"))
    assert events.scalars(whole) == before
    check_same(whole, folder_of(train, "killed"))


@pytest.mark.medium
@pytest.mark.parametrize("seconds", [0.01, *(pytest.param(s, marks=SLOW) for s in (0, 0.05))])
def test_two_interrupts_of_all_processes_end_without_an_abort(train, seconds):
    options = [*OPTIONS, "steps=1000", "validate_every=1000"]
    process, output = start_or_resume(train, "interrupted", *options)
    wait_for(lambda: list(train.logs.glob("interrupted/*/checkpoints/previous.ckpt")), process)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(seconds)
    with suppress(ProcessLookupError):  # it has ended already
        os.killpg(process.pid, signal.SIGINT)
    process.join()
    text = output.read_text()
    assert process.exitcode == 1 and "stopped; to go on, add ckpt_path=" in text, text
    assert "Traceback" not in text and "terminate called" not in text


@pytest.mark.medium
def test_a_signal_to_all_processes_and_then_a_lost_loader(train):
    options = [*OPTIONS, "steps=1000", "validate_every=1000"]
    process, output = start_or_resume(train, "preempted", *options)
    wait_for(lambda: list(train.logs.glob("preempted/*/checkpoints/previous.ckpt")), process)
    os.killpg(process.pid, signal.SIGTERM)
    process.join()
    text = output.read_text()
    assert process.exitcode == 128 + signal.SIGTERM, text
    saved = int(re.search(r"SIGTERM: saved at step (\d+)", text)[1])
    last = folder_of(train, "preempted") / "checkpoints" / "last.ckpt"
    assert read_metadata(last)["global_step"] == saved >= 2
    assert f"stopped; to go on, add ckpt_path={last} to the same command" in text

    before = last.stat().st_mtime
    process, output = start_or_resume(train, "preempted", *options)
    wait_for(lambda: last.exists() and last.stat().st_mtime > before, process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert children
    for worker in children:
        os.kill(int(worker), signal.SIGKILL)
    process.join()
    text = output.read_text()
    assert process.exitcode == 1, text
    assert f"resuming from {last}" in text and text.count("stopped; to go on") == 2
    assert "error: a process that loads data was lost (DataLoader worker (pid" in text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    "killed", [pytest.param("other", marks=SLOW), pytest.param("main", marks=SLOW)]
)
def test_one_of_two_processes_is_killed(train, killed):
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "data.batch_size=2"]
    options = [*two, "steps=1000", "validate_every=1000", "callbacks.checkpoints.minutes=0"]
    with train.start("name=two", *options, until="previous.ckpt") as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        (other,) = (c for c in children if b"train.py" in Path(f"/proc/{c}/cmdline").read_bytes())
        os.kill(process.pid if killed == "main" else int(other), signal.SIGKILL)
        output, errors = process.communicate(timeout=120)  # both have closed the pipe
    # Whichever is first: the connection's end, or Lightning's watch over the processes it started.
    lost = "error: the connection to another process of this training was lost"
    watched = "terminated with code -9. Forcefully terminating all other processes"
    assert lost in errors or (killed == "other" and watched in errors)
    assert "Traceback" not in errors
    assert output.count("model: ") == 1
    last = folder_of(train, "two") / "checkpoints" / "last.ckpt"
    assert read_metadata(last)["global_step"] > 0
