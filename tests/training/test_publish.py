"""A run becomes a model to ship: its weights in half precision, and a card."""

import pytest
import torch
from conftest import COSTS
from safetensors.torch import load_file

from asysplat.errors import InputError
from asysplat.training import publish as publishing
from asysplat.training.publish import publish


@pytest.fixture
def run(train):
    """The folder of a finished run."""
    result = train("steps=2", COSTS)
    assert result.returncode == 0, result.stderr
    return next(path.parent for path in train.logs.rglob("metrics.json"))


@pytest.mark.medium
def test_a_run_is_published(run, tmp_path, monkeypatch):
    target = tmp_path / "checkpoints" / "net"
    publish(run, target)
    weights = load_file(target.with_suffix(".safetensors"))
    trained = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    assert weights.keys() == trained.keys()
    for name, there in trained.items():
        torch.testing.assert_close(weights[name].to(there), there, rtol=1e-3, atol=1e-6)
    card = target.with_suffix(".md").read_text()
    for part in (
        "python train.py",
        "2 steps of",
        "revision",
        "| this model |",
        "| step | minutes | psnr |",
    ):
        assert part in card, card
    # What was written by hand outlives the next one.
    target.with_suffix(".md").write_text(card + "\n## Limits\n\nNot for mirrors.\n")
    publish(run, target)
    again = target.with_suffix(".md").read_text()
    assert again == card + "\n## Limits\n\nNot for mirrors.\n"

    monkeypatch.setattr(publishing, "LARGEST", 1000)
    with pytest.raises(InputError, match=r"at most 0 MB ship; train a narrower model"):
        publish(run, target)


def test_a_run_that_did_not_finish_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"is no finished run: .*metrics.json is missing"):
        publish(tmp_path, tmp_path / "net")
    assert not (tmp_path / "net.safetensors").exists()
