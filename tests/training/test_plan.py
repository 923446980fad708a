"""The plan of a training: printed before its first step, or refused with what would fit."""

import re

from conftest import COSTS

from asysplat.training import plan
from asysplat.training.plan import Plan

FEW = [COSTS, "steps=1", "validate_every=1", "data.test_sets=null", "data.batch_size=2"]


def test_a_plan_in_words():
    told = str(
        Plan(
            parameters=98_111_472,
            steps=60_000,
            parts={"weights": 1.57, "activations": 34.9},
            held_gb=0.5,
            capacity_gb=141.2,
            tried_gb=38.2,
            seconds=1.9,
            disk_gb=3.5,
            free_gb=812.0,
        )
    )
    for part in ("98.11M", "about 37 of 141 GB", "activations 35", "took 38", "1 day, 7:40:00"):
        assert part in told
    assert "checkpoints of 3.5 GB, 812 free" in told


def test_what_does_not_fit_is_refused(train, monkeypatch, tmp_path):
    """By memory, with the settings that would do; by the disk."""
    monkeypatch.setattr(plan, "memory_gb", lambda device: 0.001)
    result = train(*FEW)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert re.search(
        r"error: a training step needs about \S+ GB, and each process has 0.001: take fewer",
        result.stderr,
    )
    monkeypatch.setattr(plan, "memory_gb", lambda device: 1000.0)
    monkeypatch.setattr(plan, "SAVED_BYTES", 1e15)
    result = train(*FEW)
    assert result.returncode != 0 and "the disk of paths.logs has" in result.stderr
    assert not list(tmp_path.rglob("last.ckpt"))
