"""TrainingMonitor: shares, rates and norms of a step."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, local
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
from torch.optim import Optimizer

from asysplat.evaluation import measured_cost
from asysplat.evaluation.measured_cost import peak_flops
from asysplat.training import step_timer
from asysplat.training.callbacks import TrainingMonitor, monitor
from asysplat.training.callbacks.monitor import gradient_norms, summary
from asysplat.training.module import SplattingModule
from asysplat.training.step_timer import StepTimer

CPU = torch.device("cpu")


class Clock(local):
    """A clock of each thread that only a test advances."""

    seconds = 0.0

    def perf_counter(self):
        return self.seconds

    def wait(self, seconds):
        self.seconds += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    for module in (monitor, step_timer):
        monkeypatch.setattr(module, "time", clock)
    return clock


class Run:
    """The hooks of a training, with what is logged."""

    def __init__(self, clock, every, accumulate=1):
        self.clock, self.accumulate, self.logged = clock, accumulate, {}
        self.monitor = TrainingMonitor(every)
        self.monitor.flops, self.monitor.peak = 6e9, None
        self.monitor.first_step, self.monitor.begin_step = 0, None
        logger = SimpleNamespace(log_metrics=self.log)
        self.trainer = Mock(lightning.Trainer, global_step=0, world_size=2, loggers=[logger])
        self.module = Mock(SplattingModule, timer=StepTimer(), device=CPU, net=nn.ModuleDict())
        views = [SimpleNamespace(num_views=count) for count in (3, 2)]
        self.batch = {"scene": ["a", "b"], "inputs": views[0], "targets": views[1]}
        self.monitor.on_train_epoch_start()

    def log(self, numbers, step):
        self.logged.setdefault(step, {}).update(numbers)

    def step(self, data=1.0, network=4.0, backward=3.0, optimizer=0.5, rest=1.5):
        hooks = (self.trainer, self.module)
        for batch in range(self.accumulate):
            self.clock.wait(data)
            self.monitor.on_train_batch_start(*hooks, self.batch, batch)
            self.clock.wait(rest)
            with self.module.timer("network"):
                self.clock.wait(network)
            self.monitor.on_before_backward(*hooks, None)
            self.clock.wait(backward)
            self.monitor.on_after_backward(*hooks)
            if batch == self.accumulate - 1:
                self.monitor.on_before_optimizer_step(*hooks, Mock(Optimizer))
                self.clock.wait(optimizer)
                self.trainer.global_step += 1
            self.monitor.on_train_batch_end(*hooks, None, self.batch, batch)


def test_shares_and_rates_of_measured_steps(clock):
    run = Run(clock, every=3)
    run.step(network=100)  # the first, which compiles, is not counted
    run.step()
    run.step(network=14)
    clock.wait(1000)  # a validation
    run.monitor.on_train_epoch_start()
    for _ in range(3):
        run.step()
    assert run.logged.keys() == {2, 5}
    first, second = run.logged.values()
    # Ten seconds in the second step and twenty in the third, two scenes of five views each.
    assert first["time/seconds_per_step"] == 15 and second["time/seconds_per_step"] == 10
    assert first["time/views_per_second"] == pytest.approx(2 * 2 * 2 * 5 / 30)
    assert first["time/gflops_per_second"] == pytest.approx(2 * 2 * 6 / 30)
    expected = {"data": 1, "network": 14, "backward": 3, "optimizer": 0.5, "other": 1.5}
    for part in (*step_timer.PARTS, "other"):
        assert first[f"time/share_{part}"] == pytest.approx(expected.get(part, 0) / 20)
    assert "time/mfu" not in first and first["memory/peak_gb"] > 0
    text = summary(second)
    assert "took 10 s, 2 views/s: data 10%, network 40%" in text
    assert "MFU not measured" in text


def test_a_step_of_several_micro_batches(clock):
    run = Run(clock, every=2, accumulate=2)
    run.monitor.peak = 12e9
    for _ in range(4):
        run.step()
    found = run.logged[3]
    assert found["time/seconds_per_step"] == 2 * 9.5 + 0.5
    assert found["time/share_network"] == pytest.approx(8 / 19.5)
    assert found["time/share_data"] == pytest.approx(2 / 19.5)
    assert found["time/mfu"] == pytest.approx(4 * 6 / 19.5 / 12)
    assert "MFU 10.3%" in summary(found)


def test_seconds_of_parallel_threads_are_averaged(clock):
    measured, together = StepTimer(), Barrier(2)
    with measured("network"):  # before the start
        clock.wait(1)
    measured.start(CPU)

    def work(seconds):
        with measured("network"):
            together.wait(10)  # so that each has a thread of its own
            clock.wait(seconds)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, (2, 4)))
    with measured("loss"):
        clock.wait(7)
    seconds = {name: spent for name, spent in measured.stop().items() if spent}
    assert seconds == {"network": 3, "loss": 7}


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
