"""A resumed run takes the same steps as an uninterrupted one."""

import os
import signal

import events
import lightning
import pytest
import torch
from full_disk import largest_file
from lightning.pytorch.loggers import TensorBoardLogger
from tiny import QUIET, OneLayer
from torch.utils.data import DataLoader

from asysplat.data.loader import EpochLoader, batches_done
from asysplat.errors import InputError
from asysplat.runs.checkpoints import read_metadata
from asysplat.training.callbacks import Checkpoints
from asysplat.training.callbacks.checkpoints import AtomicCheckpointIO

PER_EPOCH = 3


class Killed(Exception):
    pass


class Numbers(lightning.LightningDataModule):
    """Task i is the number i."""

    def train_dataloader(self):
        done, start = batches_done(self.trainer), self.trainer.current_epoch * PER_EPOCH
        tasks = torch.arange(start + done, start + PER_EPOCH)
        return EpochLoader(done, tasks, batch_size=None, generator=torch.Generator())

    def val_dataloader(self):
        return DataLoader([0.0], generator=torch.Generator())


class Module(OneLayer):
    """It gets worse with every validation; `at_step` is called in each step."""

    def __init__(self, at_step=None, measured=True):
        super().__init__(inputs=2)
        self.at_step, self.measured = at_step, measured

    def training_step(self, batch, index):
        if self.at_step is not None:
            self.at_step(self.global_step)
        loss = self.layer(torch.rand(2) + batch).sum()
        self.log_dict({"task": batch.float(), "index": float(index), "loss": loss})
        return loss

    def on_train_epoch_end(self):
        self.log("ended", float(self.current_epoch))

    def validation_step(self, batch, index):
        if self.measured:
            self.log("val/psnr", 20.0 - self.global_step)


def fit(folder, module, steps=7, checkpoint=None, minutes=None):
    """Train with PER_EPOCH steps an epoch, a validation after each."""
    checkpoints = Checkpoints(
        dirpath=folder / "checkpoints",
        minutes=minutes,
        filename="best",
        monitor="val/psnr",
        mode="max",
        save_on_train_epoch_end=True,
        enable_version_counter=False,
    )
    trainer = lightning.Trainer(
        **QUIET | {"logger": TensorBoardLogger(folder, "tensorboard", "")},
        max_steps=steps,
        max_epochs=-1,
        reload_dataloaders_every_n_epochs=1,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        callbacks=[checkpoints],
        plugins=[AtomicCheckpointIO()],
    )
    trainer.fit(module, datamodule=Numbers(), ckpt_path=checkpoint, weights_only=True)


def steps_kept(folder) -> dict[str, int]:
    return {path.stem: read_metadata(path)["global_step"] for path in folder.rglob("*.ckpt")}


KEPT = {
    "last_two_and_an_earlier_best": (9, None, True, {"best": 3, "previous": 6, "last": 9}),
    "end_within_an_epoch": (7, None, True, {"best": 3, "previous": 6, "last": 7}),
    "between_validations": (5, 0, True, {"best": 3, "previous": 4, "last": 5}),
    "no_best_without_metrics": (4, None, False, {"previous": 3, "last": 4}),
}


@pytest.mark.parametrize("case", KEPT)
def test_checkpoints_of_a_run(tmp_path, case):
    steps, minutes, measured, expected = KEPT[case]
    fit(tmp_path, Module(measured=measured), steps=steps, minutes=minutes)
    assert steps_kept(tmp_path) == expected


@pytest.mark.parametrize("minutes", [None, 0])
def test_a_run_killed_in_every_step_has_the_same_steps_and_logs(tmp_path, minutes):
    torch.manual_seed(0)
    whole = Module()
    fit(tmp_path / "whole", whole)
    assert events.scalars(tmp_path / "whole")["task"] == [(i, i) for i in range(7)]

    folder = tmp_path / "killed"
    found = folder / "checkpoints" / "last.ckpt"
    torch.manual_seed(0)
    last = None
    for at in range(1, 7):  # each process is killed a step later

        def kill(step, at=at):
            if step == at:
                raise Killed

        with pytest.raises(Killed):
            fit(folder, Module(kill), checkpoint=last, minutes=minutes)
        torch.manual_seed(0 if last is None else 7)  # another process has other numbers
        last = found if found.exists() else None
    killed = Module()
    fit(folder, killed, checkpoint=last, minutes=minutes)
    assert torch.equal(killed.layer.weight, whole.layer.weight)
    assert events.scalars(folder) == events.scalars(tmp_path / "whole")


def test_more_steps_resume_at_the_end(tmp_path):
    fit(tmp_path, Module(), steps=6)
    last = tmp_path / "checkpoints" / "last.ckpt"
    fit(tmp_path, Module(), steps=9, checkpoint=last)
    found = events.scalars(tmp_path)
    assert found["task"] == [(i, i) for i in range(9)]
    assert found["ended"] == [(2, 0), (5, 1), (8, 2)]
    assert [step for step, _ in found["val/psnr"]] == [2, 5, 8]


def send(number, at):
    """Sends this process a signal in a step."""
    return lambda step: os.kill(os.getpid(), number) if step == at else None


@pytest.mark.parametrize("at", [1, 2])
def test_a_signal_saves_the_step_and_ends_the_run(tmp_path, capsys, at):
    """Within an epoch and in its last step, after which it is validated first."""
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        fit(tmp_path, Module(send(signal.SIGTERM, at)))
    assert end.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before
    assert steps_kept(tmp_path)["last"] == at + 1
    output = capsys.readouterr().out
    last = tmp_path / "checkpoints" / "last.ckpt"
    assert f"SIGTERM: saved at step {at + 1}\nstopped; to go on, add ckpt_path={last}" in output
    fit(tmp_path, Module(), checkpoint=last)
    assert events.scalars(tmp_path)["task"] == [(i, i) for i in range(7)]


def test_a_signal_of_another_handler_is_passed_on_after_saving(tmp_path):
    """As submitit's, which asks for the job once more."""
    calls = []
    before = signal.signal(
        signal.SIGUSR2, lambda number, _: calls.append((number, steps_kept(tmp_path)["last"]))
    )
    try:
        fit(tmp_path, Module(send(signal.SIGUSR2, at=4)))
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert calls == [(signal.SIGUSR2, 5)]
    assert steps_kept(tmp_path)["last"] == 7


def test_a_full_disk_keeps_the_earlier_checkpoints(tmp_path, capsys):
    fit(tmp_path, Module(), steps=6)
    kept = steps_kept(tmp_path)
    last = tmp_path / "checkpoints" / "last.ckpt"
    with (
        pytest.raises(InputError, match=r"next\.ckpt cannot be written \(File too large\): name"),
        largest_file(last.stat().st_size // 2),
    ):
        fit(tmp_path, Module(), steps=9, checkpoint=last)
    assert steps_kept(tmp_path) == kept
    assert "stopped; to go on, add ckpt_path=" in capsys.readouterr().out
    fit(tmp_path, Module(), steps=9, checkpoint=last)
    assert events.scalars(tmp_path)["task"] == [(i, i) for i in range(9)]
