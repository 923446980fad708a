"""A training of the laptop scale learns where surfaces are, not only how they look."""

import lightning
import pytest
import torch
from hydra.utils import instantiate
from lightning import LightningDataModule
from tiny import QUIET

from asysplat.evaluation.metrics import abs_rel
from asysplat.training import SplattingModule

STEPS = 60
SMALLER = ["data.height=48", "data.width=48", "data.inputs=6", "data.targets=2"]
SMALLER += ["data.num_workers=0", "data.num_images=48", "data.window=[24,48]"]


def mean_abs_rel(module: SplattingModule, data: LightningDataModule) -> float:
    with torch.no_grad():
        predictions = [(module.eval()(batch, depth=True), batch) for batch in data.val_dataloader()]
    errors = [abs_rel(p.rendering.depth, batch["targets"].depths) for p, batch in predictions]
    return torch.cat(errors).mean().item()


@pytest.mark.medium
@pytest.mark.parametrize("seed", [0])
def test_depths_are_better_after_few_steps(composed, seed):
    config = composed(*SMALLER)
    lightning.seed_everything(seed, verbose=False)
    data = instantiate(config.data)
    data.setup()
    module = instantiate(config.training, net=instantiate(config.model))
    untrained = mean_abs_rel(module, data)
    trainer = lightning.Trainer(
        **QUIET, max_steps=STEPS, limit_val_batches=0, enable_checkpointing=False
    )
    trainer.fit(module.train(), data)
    assert mean_abs_rel(module, data) < 0.9 * untrained
