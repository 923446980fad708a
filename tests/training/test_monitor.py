"""TrainingMonitor: rates, and norms of a step."""

from types import SimpleNamespace
from unittest.mock import Mock

import lightning
import pytest
import torch
from torch import nn

from asysplat.training.callbacks import TrainingMonitor, monitor
from asysplat.training.callbacks.monitor import gradient_norms
from asysplat.training.module import SplattingModule

CPU = torch.device("cpu")


def test_rates_are_those_of_all_steps_but_not_of_validations(monkeypatch):
    clock, logged = SimpleNamespace(now=0.0), {}
    monkeypatch.setattr(monitor.time, "perf_counter", lambda: clock.now)
    logger = SimpleNamespace(log_metrics=lambda numbers, step: logged.update({step: numbers}))
    trainer = Mock(lightning.Trainer, global_step=0, world_size=2, loggers=[logger])
    module = Mock(SplattingModule, device=CPU, net=nn.ModuleDict())
    views = [SimpleNamespace(num_views=count) for count in (3, 2)]
    batch = {"scene": ["a", "b"], "inputs": views[0], "targets": views[1]}
    watch = TrainingMonitor(every=2)
    watch.on_train_start()
    for seconds in (10, 20):
        clock.now += 1000  # a validation
        watch.on_train_epoch_start()
        for _ in range(2):  # micro-batches
            clock.now += seconds / 2
            watch.steps += _
            trainer.global_step += _
            watch.on_train_batch_end(trainer, module, None, batch)
    values = logged[1]
    assert values["time/seconds_per_step"] == 15
    assert values["time/views_per_second"] == pytest.approx(2 * 2 * 2 * 2 * 5 / 30)
    assert values["memory/peak_gb"] > 0


def test_gradient_norms_by_part():
    net = nn.ModuleDict({name: nn.Linear(2, 1) for name in ("geometry", "head", "unused")})
    net["geometry"].weight.grad = torch.tensor([[3.0, 0.0]])
    net["geometry"].bias.grad = torch.tensor([4.0])
    net["head"].bias.grad = torch.tensor([-2.0])
    assert gradient_norms(net) == {"gradient/geometry": 5, "gradient/head": 2}
