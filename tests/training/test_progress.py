"""Progress of a run: bars on a terminal, lines elsewhere; also when resumed."""

import lightning
import torch
from lightning.pytorch.callbacks import RichProgressBar
from tiny import QUIET, OneLayer
from torch.utils.data import DataLoader

from asysplat.training import loggers


class Module(OneLayer):
    """Its quality is always the same."""

    def training_step(self, batch, index):
        self.log("train/psnr", 20.0, prog_bar=True)
        return super().training_step(batch, index)

    def validation_step(self, batch, index):
        self.log("val/psnr", 18.5)

    def test_step(self, batch, index, dataloader_idx=0):
        pass


def loader(count=2):
    return DataLoader(torch.zeros(count, 2))


def fit(tmp_path, steps, checkpoint=None):
    """Two steps an epoch, a validation after each, then a test of two sets of three scenes."""
    trainer = lightning.Trainer(
        **QUIET,
        max_steps=steps,
        max_epochs=-1,
        num_sanity_val_steps=0,
        callbacks=[loggers.ProgressLines()],
        enable_checkpointing=False,
        default_root_dir=tmp_path,
    )
    trainer.fit(Module(), loader(), loader(3), ckpt_path=checkpoint, weights_only=True)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    trainer.test(Module(), [loader(3), loader(3)], verbose=False)


def lines(text):
    return [line for line in text.splitlines() if line.startswith("step")]


def test_lines_after_each_validation_without_a_terminal(tmp_path, capsys):
    fit(tmp_path, 6)
    output = lines(capsys.readouterr().out)
    steps = [line.partition(" left")[0].rpartition(",")[0] for line in output]
    assert steps == ["step 2 of 6", "step 4 of 6", "step 6 of 6"]
    assert all(line.endswith("left: PSNR 20.0, validation 18.5") for line in output)
    fit(tmp_path, 10, checkpoint=tmp_path / "last.ckpt")
    output = lines(capsys.readouterr().out)
    assert [line.split(",")[0] for line in output] == ["step 8 of 10", "step 10 of 10"]


def test_bars_on_a_terminal_alone(monkeypatch):
    assert isinstance(loggers.show_progress(), loggers.ProgressLines)
    monkeypatch.setattr(loggers.sys.stdout, "isatty", lambda: True)
    assert isinstance(loggers.show_progress(), RichProgressBar)
