"""A non-finite step changes nothing, is counted, and too many in a row end the run."""

import lightning
import pytest
import torch
from torch.utils.data import DataLoader

from asysplat.errors import InputError
from asysplat.training.callbacks import SkipNonFiniteSteps


class Module(lightning.LightningModule):
    """One weight; the loss of step i is scaled by `scales[i]`."""

    def __init__(self, scales):
        super().__init__()
        self.scales = scales
        self.layer = torch.nn.Linear(2, 1, bias=False)
        self.history = []

    def training_step(self, batch, index):
        self.history.append(self.layer.weight.detach().clone())
        return self.layer(torch.ones(1, 2)).sum() * self.scales[index]

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.1)

    def train_dataloader(self):
        batches = [{"scene": ["kitchen"]} for _ in self.scales]
        return DataLoader(batches, batch_size=None)


def fit(scales, tmp_path, **options):
    guard, module = SkipNonFiniteSteps(**options), Module(scales)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=1,
        callbacks=[guard],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        default_root_dir=tmp_path,
        gradient_clip_val=1.0,
    )
    trainer.fit(module)
    return guard, module.history


def test_skipped_step_leaves_the_weights_and_is_reported(tmp_path, capsys):
    guard, history = fit([1.0, float("nan"), 1.0], tmp_path)
    assert not torch.equal(history[0], history[1])
    assert torch.equal(history[1], history[2])
    assert guard.skipped == 1 and guard.in_a_row == 0
    assert "layer.weight" in (said := capsys.readouterr().out) and "kitchen" in said


def test_budget(tmp_path):
    with pytest.raises(InputError, match=r"layer\.weight"):
        fit([float("inf")] * 3, tmp_path, budget=2)
