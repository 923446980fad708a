"""What is kept of a run: the best by its validation, and the last whether it is the best or not."""

import lightning
import pytest
import torch
from torch.utils.data import DataLoader

from asysplat.errors import InputError
from asysplat.training.callbacks import Checkpoints
from asysplat.training.checkpoints import (
    check_checkpoint,
    load_weights,
    save_weights,
)


class Module(lightning.LightningModule):
    """One weight, worse with every validation."""

    def __init__(self, measured):
        super().__init__()
        self.measured = measured
        self.layer = torch.nn.Linear(2, 1, bias=False)

    def training_step(self, batch, index):
        return self.layer(batch).sum()

    def validation_step(self, batch, index):
        if self.measured:
            self.log("val/psnr", 20.0 - self.global_step)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def steps_kept(folder, steps, measured=True) -> dict[str, int]:
    """Train with two steps an epoch; return the step of each checkpoint that is left."""
    checkpoints = Checkpoints(
        dirpath=folder,
        filename="best",
        monitor="val/psnr",
        mode="max",
        save_on_train_epoch_end=True,
        enable_version_counter=False,
    )
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        max_epochs=-1,
        num_sanity_val_steps=0,
        callbacks=[checkpoints],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    data = DataLoader(torch.zeros(2, 2))
    trainer.fit(Module(measured), data, data)
    return {
        path.stem: torch.load(path, weights_only=True)["global_step"]
        for path in folder.glob("*.ckpt")
    }


def test_the_last_is_kept_though_an_earlier_one_is_the_best(tmp_path):
    assert steps_kept(tmp_path, 6) == {"best": 2, "last": 6}


def test_the_end_is_kept_though_it_is_within_an_epoch(tmp_path):
    assert steps_kept(tmp_path, 5) == {"best": 2, "last": 5}


def test_nothing_is_the_best_where_nothing_measures(tmp_path):
    assert steps_kept(tmp_path, 4, measured=False) == {"last": 4}


def test_a_file_that_is_none_is_one_sentence(tmp_path):
    path = tmp_path / "notes.ckpt"
    path.write_text("a text")
    with pytest.raises(InputError, match=r"notes\.ckpt cannot be read as a checkpoint: [^\n]*$"):
        check_checkpoint(path, torch.nn.Linear(1, 1))


def test_weights_alone_are_read_as_they_were_written(tmp_path):
    net = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
    save_weights(net.state_dict(), tmp_path / "net.safetensors")
    again = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
    load_weights(str(tmp_path / "net.safetensors"), again)
    for name, tensor in again.state_dict().items():
        torch.testing.assert_close(tensor, net.state_dict()[name], rtol=1e-3, atol=1e-6)
        assert tensor.dtype == net.state_dict()[name].dtype


def test_weights_of_another_model_are_refused(tmp_path):
    save_weights(torch.nn.Linear(3, 2).state_dict(), tmp_path / "net.safetensors")
    with pytest.raises(InputError, match=r"bias is \(2,\) there and \(3,\) here"):
        load_weights(str(tmp_path / "net.safetensors"), torch.nn.Linear(3, 3))
