"""Costs of a test, which are of the network alone, and of a step."""

import mmap

import lightning
import pytest
import torch
from tiny import QUIET
from tiny_runs import COSTS
from torch import nn
from torch.utils.data import DataLoader

from asysplat.evaluation.measured_cost import CostMeter, reset_peak_memory
from asysplat.training.callbacks import Costs, costs
from asysplat.training.module import SplattingModule

MB = 1_000_000
# The process's other work was under 1 MB; the tolerance is far below a buffer.
TOLERANCE_GB = 0.02


def allocate(megabytes):
    """Fill memory that the system gives and takes back: malloc may hold as much from earlier."""
    torch.frombuffer(mmap.mmap(-1, megabytes * MB), dtype=torch.uint8).fill_(1)


class Net(nn.Module):
    def forward(self, megabytes):
        allocate(megabytes)


class Module(SplattingModule):
    def __init__(self, rendering):
        super(SplattingModule, self).__init__()
        self.net, self.rendering = Net(), rendering

    def test_step(self, batch, batch_idx, dataloader_idx=0):
        self.net(batch)
        allocate(self.rendering)


class Afterwards(lightning.Callback):
    """Works at the end of a test step, like the callbacks Metrics and Figures."""

    def on_test_batch_end(self, *_):
        allocate(700)


def measure(sets, rendering=1):
    """Costs of a test; `sets` gives the megabytes of each prediction of each test set."""
    data = lightning.LightningDataModule()
    data.name, data.tests = "main", sets
    data.test_dataloader = lambda: [DataLoader(list(s), batch_size=None) for s in sets.values()]
    costs, module = Costs(), Module(rendering)
    trainer = lightning.Trainer(**QUIET, callbacks=[costs, Afterwards()])
    trainer.test(module, data, verbose=False)
    assert not module.net._forward_hooks and not module.net._forward_pre_hooks
    return {key.removeprefix("cost/"): value for key, value in costs.values.items()}


resident = pytest.mark.skipif(
    not reset_peak_memory("cpu"), reason="the peak of the process cannot be reset"
)


@pytest.mark.medium
@resident
def test_memory_of_each_test_set_is_that_of_its_predictions():
    sets = {"main": [1, 300, 1], "more_views": [200, 1], "small": [1, 1]}
    costs = measure(sets, rendering=300)  # which does not count
    for key, expected in (("inference_gb", 0.3), ("more_views/inference_gb", 0.2)):
        # Beside a set of the same test: the system may take back pages of the libraries meanwhile.
        rise = costs[key] - costs["small/inference_gb"]
        assert rise == pytest.approx(expected, abs=TOLERANCE_GB)


def test_seconds_of_steps_are_the_mean_of_all():
    """As the paper's (Suppl. A): kernels are compiled in the plan's steps, before the first."""
    costs = Costs()
    costs.step = CostMeter(torch.device("cpu"))
    costs.step.seconds = [30.0, 1.0, 3.0]
    trainer = lightning.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.accumulate_grad_batches = 4
    costs.on_fit_end(trainer, Module(1))
    assert costs.values == {"cost/seconds_per_step": 4 * 34 / 3}


@pytest.mark.medium
def test_what_does_not_fit_is_refused_before_the_first_step(train, monkeypatch, tmp_path):
    monkeypatch.setattr(costs, "memory_gb", lambda device: 0.001)
    result = train(COSTS, "steps=1", "validate_every=1", "data.test_sets=null")
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert "and each process has 0.001 GB: set training.checkpoint_layers=true" in result.stderr
    assert not list(tmp_path.rglob("last.ckpt"))
