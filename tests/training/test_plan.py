"""The plan of a training: printed before its first step, or refused with what would fit."""

import pytest
from conftest import COSTS

from asysplat.training import plan
from asysplat.training.plan import plan_lines

FEW = [COSTS, "steps=1", "validate_every=1", "data.test_sets=null", "data.batch_size=2"]


def test_plan_in_words():
    words = plan_lines(98_111_472, 60_000, 37.0, 141.2, 1.9, 3.5, 812.0)
    for part in ("98.11M", "about 37 of 141 GB", "1 day, 7:40:00"):
        assert part in words
    assert "checkpoints of 3.5 GB, 812 free" in words


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("memory_gb", lambda device: 0.001, r"and each process has 0.001 GB: set training.checkp"),
        ("SAVED_BYTES", 1e15, "the disk of paths.logs has"),
    ],
)
def test_what_does_not_fit_is_refused(train, monkeypatch, tmp_path, name, value, message):
    monkeypatch.setattr(plan, name, value)
    result = train(*FEW)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert message in result.stderr
    assert not list(tmp_path.rglob("last.ckpt"))
