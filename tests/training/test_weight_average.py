"""Averages of weights: the formula, resumption to the same bits, and what measures them."""

import json

import lightning
import pytest
import torch
from hydra.utils import instantiate
from test_checkpoints import Killed, Module, Numbers
from tiny import QUIET
from tiny_runs import finished
from torch import nn

from asysplat.training.callbacks import Checkpoints, WeightAverage
from asysplat.training.callbacks.weight_average import TRAINED

DECAY = 0.4  # the warm-up's is lower in the first five steps


class Measured(Module):
    """Its `history` are its weights after each step, its `measured` those of each validation."""

    def __init__(self, at_step=None):
        torch.manual_seed(0)
        super().__init__(at_step)
        self.norm = nn.BatchNorm1d(1)
        self.history, self.measured = [], []

    def on_train_start(self):
        self.history = [self.weights()] * (not self.history)

    def training_step(self, batch, index):
        self.norm(torch.rand(4, 1))
        return super().training_step(batch, index)

    def optimizer_step(self, *args, **options):
        super().optimizer_step(*args, **options)
        self.history.append(self.weights())

    def validation_step(self, batch, index):
        self.measured.append(self.weights())

    def test_step(self, batch, index):
        self.tested = self.weights()

    def weights(self):
        return {name: tensor.clone() for name, tensor in self.state_dict().items()}


def fit(folder, module, checkpoint=None, steps=7, decay=DECAY, accumulated=1):
    """Train with 3 steps an epoch, a validation after each; return the last checkpoint."""
    checkpoints = Checkpoints(folder, minutes=0, monitor="val/psnr", save_on_train_epoch_end=True)
    trainer = lightning.Trainer(
        **QUIET,
        max_steps=steps,
        max_epochs=-1,
        reload_dataloaders_every_n_epochs=1,
        num_sanity_val_steps=-1,
        accumulate_grad_batches=accumulated,
        callbacks=[checkpoints, *([] if decay is None else [WeightAverage(decay)])],
    )
    torch.manual_seed(0)
    trainer.fit(module, datamodule=Numbers(), ckpt_path=checkpoint, weights_only=True)
    trainer.test(module, Numbers().val_dataloader(), verbose=False)
    return torch.load(folder / "last.ckpt", weights_only=True)


def averages(history, decay=DECAY):
    """The averages after each step, by the formula; counters are not averaged."""
    found = [history[0]]
    for step, weights in enumerate(history[1:], 1):
        d, before = min(decay, (1 + step) / (10 + step)), found[-1]
        averaged = {name: d * before[name] + (1 - d) * weights[name] for name in weights}
        counters = {name: t for name, t in weights.items() if not t.is_floating_point()}
        found.append(averaged | counters)
    return found


def check_equal(found, expected, **tolerance):
    assert found.keys() == expected.keys()
    torch.testing.assert_close(found, expected, **tolerance)


def test_validations_the_test_and_checkpoints_have_the_average(tmp_path):
    module = Measured()
    checkpoint = fit(tmp_path, module)
    expected = averages(module.history)
    assert len(expected) == 8 and len(module.measured) == 3  # at the steps 0, 3 and 6
    for found, step in zip(module.measured, (0, 3, 6), strict=True):
        check_equal(found, expected[step])
    assert not torch.equal(expected[6]["layer.weight"], module.history[6]["layer.weight"])
    check_equal(module.tested, expected[7])
    check_equal(checkpoint["state_dict"], expected[7])
    check_equal(checkpoint[TRAINED], module.history[7], atol=0, rtol=0)


def test_micro_batches_are_one_step_of_the_average(tmp_path):
    module = Measured()
    checkpoint = fit(tmp_path, module, steps=2, accumulated=3)
    assert len(module.history) == 3
    check_equal(checkpoint["state_dict"], averages(module.history)[-1])


def test_the_average_changes_no_step(tmp_path):
    plain = fit(tmp_path / "plain", Measured(), decay=None)
    averaged = fit(tmp_path / "averaged", Measured())
    check_equal(averaged[TRAINED], plain["state_dict"], atol=0, rtol=0)
    assert TRAINED not in plain


@pytest.mark.parametrize("at", range(1, 7))
def test_a_killed_run_resumes_to_the_same_bits(tmp_path, at):
    def kill(step):
        if step == at:
            raise Killed

    whole, killed = Measured(), Measured()
    expected = fit(tmp_path / "whole", whole)
    with pytest.raises(Killed):
        fit(tmp_path / "killed", Measured(kill))
    found = fit(tmp_path / "killed", killed, tmp_path / "killed" / "last.ckpt")
    for key in ("state_dict", TRAINED):
        check_equal(found[key], expected[key], atol=0, rtol=0)
    check_equal(killed.tested, whole.tested, atol=0, rtol=0)


def test_a_finished_run_tests_its_average_again_and_takes_more_steps(tmp_path):
    whole, again = Measured(), Measured()
    fit(tmp_path / "whole", whole)
    fit(tmp_path / "again", Measured(), steps=6)
    last = tmp_path / "again" / "last.ckpt"
    fit(tmp_path / "again", again, last, steps=6)
    check_equal(again.tested, averages(whole.history)[6])
    more = fit(tmp_path / "again", Measured(), last)
    check_equal(more["state_dict"], averages(whole.history)[7])


def test_an_average_begins_at_a_checkpoint_without_one(tmp_path):
    fit(tmp_path, Measured(), steps=4, decay=None)
    module = Measured()
    checkpoint = fit(tmp_path, module, tmp_path / "last.ckpt", steps=5)
    before, after = module.history
    expected = 0.4 * before["layer.weight"] + 0.6 * after["layer.weight"]
    torch.testing.assert_close(checkpoint["state_dict"]["layer.weight"], expected)


def test_there_is_no_average_by_default(composed):
    assert instantiate(composed().callbacks.average) is None
    assert instantiate(composed("ema=0.999").callbacks.average).decay == 0.999


@pytest.mark.medium
def test_what_reads_a_checkpoint_measures_as_the_test(train, run_script):
    """Of weights whose last step is a large one."""
    options = ["ema=0.5", "steps=2", "learning_rate=0.1", "training.schedule.warmup_steps=0"]
    folder = finished(train(*options, "~callbacks.figures", "callbacks.checkpoints.minutes=0"))
    checkpoint = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    last, average = checkpoint[TRAINED], checkpoint["state_dict"]
    assert any(not torch.equal(last[name], average[name]) for name in average)
    result = run_script("evaluate.py", f"run={folder}", "post_optimization_steps=0")
    assert result.returncode == 0, result.stderr
    files = [
        json.loads((folder / f"{name}.json").read_text()) for name in ("metrics", "evaluation")
    ]
    tested, read = files[0]["test/procedural/psnr"], files[1]["test/procedural/post0/psnr"]
    assert read == pytest.approx(tested, abs=1e-3)
