"""Progress of a run: bars on a terminal, lines elsewhere; also when resumed."""

import io

import lightning
import pytest
import torch
from rich.console import Console
from tiny import QUIET, OneLayer
from torch.utils.data import DataLoader

from asysplat.training.callbacks import TrainingProgressBar, progress


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


def fit(tmp_path, steps, checkpoint=None, before=0):
    """Two steps an epoch, a validation after each, then a test of two sets of three scenes."""
    trainer = lightning.Trainer(
        **QUIET | {"enable_progress_bar": True},
        max_steps=steps,
        max_epochs=-1,
        num_sanity_val_steps=before,
        callbacks=[TrainingProgressBar()],
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


def test_a_validation_before_the_first_step(tmp_path, capsys):
    fit(tmp_path, 2, before=-1)
    output = lines(capsys.readouterr().out)
    assert output[0] == "step 0 of 2: validation 18.5"
    assert [line.split(",")[0] for line in output[1:]] == ["step 2 of 2"]


def test_lines_between_validations(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0)
    monkeypatch.setattr(progress, "LINE_FRACTION", 0.5)
    fit(tmp_path, 2)
    output = lines(capsys.readouterr().out)
    steps = [line.split(",")[0].split(":")[0] for line in output]
    assert steps == ["step 1 of 2", "step 2 of 2", "step 2 of 2"]  # the last after the validation


@pytest.fixture
def terminal(monkeypatch):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=80)
    monkeypatch.setattr(progress, "make_console", lambda: console)
    monkeypatch.setattr(progress, "REFRESH_SECONDS", 0)
    return screen


def test_bars_of_training_validation_and_test_on_a_terminal(tmp_path, capsys, terminal):
    fit(tmp_path, 6)
    assert not lines(capsys.readouterr().out)
    shown = terminal.getvalue()
    for text in ("training", "0/6", "6/6", "validation", "1/3", "3/3", "PSNR 20.0", "test"):
        assert text in shown
    assert "Epoch" not in shown
    assert "…" not in shown  # nothing was cut off at 80 columns
    hidden, restored = "\x1b[?25l", "\x1b[?25h"
    assert shown.count(hidden) == shown.count(restored) == 2


def test_an_error_restores_the_terminal(tmp_path, terminal, monkeypatch):
    def fail(*_):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Module, "validation_step", fail)
    with pytest.raises(RuntimeError):
        fit(tmp_path, 6)
    assert terminal.getvalue().count("\x1b[?25h") == 1
