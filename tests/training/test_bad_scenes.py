"""Errors of bad scenes are printed once and counted; too many end the run."""

import lightning
import pytest
import torch
from tiny import QUIET
from torch.utils.data import DataLoader

from asysplat.errors import InputError
from asysplat.training.callbacks import BadScenes


class Module(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, index):
        return self.layer(torch.ones(1)).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(bad_scenes, folder, **options):
    counter = BadScenes(**options)
    trainer = lightning.Trainer(
        **QUIET,
        max_epochs=1,
        callbacks=[counter],
        enable_checkpointing=False,
        default_root_dir=folder,
    )
    batches = [{"bad_scenes": errors} for errors in bad_scenes]
    trainer.fit(Module(), DataLoader(batches, batch_size=None))
    return trainer.callback_metrics, counter


def test_each_error_is_printed_once_and_all_scenes_are_counted(tmp_path, capsys):
    logged, counter = fit([["a is cut short"], [], ["b", "a is cut short"]], tmp_path)
    assert logged["train/bad_scenes"] == 3
    output = capsys.readouterr().out
    assert output == (
        "step 1: a bad scene is replaced by another: a is cut short\n"
        "step 3: a bad scene is replaced by another: b\n"
    )
    again = BadScenes()
    again.load_state_dict(counter.state_dict())
    assert (again.count, again.errors) == (3, ["a is cut short", "b"])


def test_budget(tmp_path):
    fit([["a", "b"], ["b"]], tmp_path, budget=2)
    with pytest.raises(InputError, match=r"^more than 2 training scenes .*:\n  a\n  b\n  c$"):
        fit([["a", "b"], ["b", "c"]], tmp_path, budget=2)
