"""TrainingMonitor: rates, and norms of a step."""

from types import SimpleNamespace
from unittest.mock import Mock

import lightning
import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.loggers import wandb
from lightning_utilities.core.imports import RequirementCache
from torch import nn

from asysplat.evaluation import measured_cost
from asysplat.evaluation.measured_cost import peak_flops
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


def test_the_peak_is_known_for_listed_gpus(monkeypatch):
    gpu = torch.device("cuda")
    assert peak_flops(CPU, "32-true") is None
    monkeypatch.setattr(measured_cost.torch.cuda, "get_device_name", lambda _: "NVIDIA H200")
    assert peak_flops(gpu, "bf16-mixed") == pytest.approx(989.4e12)
    assert peak_flops(gpu, "32-true") == pytest.approx(66.9e12)
    monkeypatch.setattr(measured_cost.torch, "get_float32_matmul_precision", lambda: "high")
    assert peak_flops(gpu, "32-true") == pytest.approx(494.7e12)
    monkeypatch.setattr(measured_cost.torch.cuda, "get_device_name", lambda _: "another")
    assert peak_flops(gpu, "bf16-mixed") is None


def test_error_without_wandb(monkeypatch, composed):
    monkeypatch.setattr(wandb, "_WANDB_AVAILABLE", RequirementCache("wandb>=1000"))
    with pytest.raises(InstantiationException, match=r"wandb.* not met"):
        instantiate(composed("logger=wandb", "paths.run=unused").logger)
