"""Costs of a test: of the network alone and of the rendering, without the metrics."""

from types import SimpleNamespace

import lightning
import pytest
import torch
from tiny import QUIET
from torch import nn
from torch.utils.data import DataLoader

from asysplat.data.batches import BatchSplit
from asysplat.evaluation import measured_cost
from asysplat.evaluation.measured_cost import reset_peak_memory
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.training.callbacks import Costs

MB = 1_000_000
# The process's other work was under 1 MB; the tolerance is far below a buffer.
TOLERANCE_GB = 0.02


def allocate(megabytes):
    torch.ones(megabytes * MB // 4)  # written, so resident; given back to the system when freed


class Net(nn.Module):
    def forward(self, megabytes):
        allocate(megabytes)


class Module(lightning.LightningModule):
    def __init__(self, rendering):
        super().__init__()
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


@resident
def test_inference_memory_is_that_of_the_prediction():
    plain = measure({"main": [1, 1]})
    predicting = measure({"main": [1, 300, 1]})
    rendering = measure({"main": [1, 1]}, rendering=300)
    rise = predicting["inference_gb"] - plain["inference_gb"]
    assert rise == pytest.approx(0.3, abs=TOLERANCE_GB)
    assert predicting["render_gb"] == pytest.approx(plain["render_gb"], abs=TOLERANCE_GB)
    assert rendering["inference_gb"] == pytest.approx(plain["inference_gb"], abs=TOLERANCE_GB)
    rise = rendering["render_gb"] - plain["render_gb"]
    assert rise == pytest.approx(0.3, abs=TOLERANCE_GB)


@resident
def test_each_test_set_has_its_own_costs():
    found = measure({"main": [1, 1], "more_views": [200, 1]})
    rise = found["more_views/inference_gb"] - found["inference_gb"]
    assert rise == pytest.approx(0.2, abs=TOLERANCE_GB)
    assert found["inference_seconds"] > 0 and found["more_views/render_seconds"] > 0


def test_seconds_leave_the_longest_out(monkeypatch):
    # Four times per scene: start and end of the prediction and of the rendering.
    clock = iter([0.0, 1.0, 1.0, 2.0, 10.0, 40.0, 40.0, 44.0, 50.0, 53.0, 53.0, 59.0])
    monkeypatch.setattr(measured_cost, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    found = measure({"main": [1, 1, 1]})
    assert (found["inference_seconds"], found["render_seconds"]) == (2.0, 2.5)


def test_seconds_of_steps_leave_the_longest_out(monkeypatch):
    costs = Costs()
    costs.split = BatchSplit(processes=1, micro_batch=1, accumulated=1)
    costs.step = CostMeter(torch.device("cpu"))
    costs.step.seconds = [30.0, 1.0, 3.0]
    monkeypatch.setattr(costs, "_render_seconds", lambda *_: 0.5)
    trainer = lightning.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    costs.on_fit_end(trainer, Module(1))
    expected = {"cost/seconds_per_step": 2.0, "cost/render_seconds_per_step": 0.5}
    assert costs.values == expected
