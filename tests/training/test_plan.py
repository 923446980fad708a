"""A training that does not fit is refused before its first step, with what would fit."""

from conftest import COSTS

from asysplat.training import plan


def test_what_does_not_fit_is_refused(train, monkeypatch, tmp_path):
    monkeypatch.setattr(plan, "memory_gb", lambda device: 0.001)
    result = train(COSTS, "steps=1", "validate_every=1", "data.test_sets=null")
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert "and each process has 0.001 GB: set training.checkpoint_layers=true" in result.stderr
    assert not list(tmp_path.rglob("last.ckpt"))
