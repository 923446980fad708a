"""What a run survives: it goes on with the same bits, or stops with a clear word."""

import csv
import os
import random
import signal
import time
from pathlib import Path

import lives
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

OPTIONS = ["callbacks.checkpoints.minutes=0", "data.num_workers=1", "data.batch_size=2"]


def folder_of(train, name) -> Path:
    """The one folder of all lives of a run."""
    (folder,) = (train.logs / name).iterdir()
    return folder


def wait_for(found, process, seconds=300):
    """Wait until `found()`, or the end of the process."""
    end = time.monotonic() + seconds
    while process.is_alive() and not found():
        assert time.monotonic() < end
        time.sleep(0.005)


def live(train, name, *overrides):
    """Begin a life of a run: a new run, or where the last life ended."""
    known = list(train.logs.glob(f"{name}/*/checkpoints/*.ckpt"))
    asked = ["ckpt_path=last"] if known else []
    said = train.logs / f"{name}.txt"
    if not known:  # a life before was too short to leave something
        for folder in train.logs.glob(f"{name}/*"):
            folder.rename(train.logs / f"{name}-{folder.name}")
    return lives.begin(said, *train.complete(f"name={name}", *overrides, *asked)), said


def kill_at_random_moments(train, kills, longest, *overrides):
    """Kill a run at random moments, up to `longest` seconds after it has built its model."""
    moments = random.Random(0)
    killed = 0
    for _ in range(kills):
        said = train.logs / "killed.txt"
        before = said.read_text().count("model: ") if said.exists() else 0
        process, said = live(train, "killed", *overrides)
        wait_for(lambda: said.exists() and said.read_text().count("model: ") > before, process)  # noqa: B023
        time.sleep(moments.uniform(0, longest))
        killed += process.is_alive()
        process.kill()
        process.join()
    process, said = live(train, "killed", *overrides)
    process.join()
    assert process.exitcode == 0, said.read_text()
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


def scalars(folder):
    """What TensorBoard shows of a run, but times: steps and values by tag."""
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith("cost/")]
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in tags}


def images(folder):
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    return {tag: [e.step for e in events.Images(tag)] for tag in events.Tags()["images"]}


def check_same(whole, killed):
    weights, survived = last_weights(whole), last_weights(killed)
    assert weights.keys() == survived.keys()
    assert [name for name in weights if not torch.equal(weights[name], survived[name])] == []
    for name in ("curve.csv", "metrics.csv"):
        assert rows(whole / name) == rows(killed / name) != []
    assert scalars(whole) == scalars(killed) != {}
    assert images(whole) == images(killed) != {}
    assert (killed / "checkpoints" / "previous.ckpt").exists()


@pytest.mark.slow
def test_killed_three_times_it_ends_with_the_same_bits_and_logs(train):
    options = [*OPTIONS, "steps=8", "validate_every=4"]
    process, said = live(train, "whole", *options)
    process.join()
    assert process.exitcode == 0, said.read_text()
    assert kill_at_random_moments(train, 3, 3, *options) > 0
    check_same(folder_of(train, "whole"), folder_of(train, "killed"))
