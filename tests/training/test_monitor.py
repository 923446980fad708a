"""TrainingMonitor: rates, norms of a step, and the band of the loss."""

import warnings
from types import SimpleNamespace
from unittest.mock import Mock

import lightning
import numpy as np
import pytest
import torch
from torch import nn

from asysplat.training.callbacks import TrainingMonitor, monitor
from asysplat.training.callbacks.monitor import LossBand, gradient_norms
from asysplat.training.module import SplattingModule

CPU = torch.device("cpu")


def test_rates_are_those_of_all_steps_but_not_of_validations(monkeypatch):
    clock, logged = SimpleNamespace(now=0.0), {}
    monkeypatch.setattr(monitor.time, "perf_counter", lambda: clock.now)
    logger = SimpleNamespace(log_metrics=lambda numbers, step: logged.update({step: numbers}))
    trainer = Mock(lightning.Trainer, global_step=0, world_size=2, loggers=[logger])
    trainer.callback_metrics = {"train/loss": torch.tensor(0.5)}
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


INTERVAL = np.arange(200)
CURVES = {
    "falls as a power": (1 + INTERVAL) ** -0.5,
    "falls to a level": 0.1 + 0.9 * np.exp(-INTERVAL / 30),
    "falls to nothing": np.exp(-INTERVAL / 40),
    "stays": np.full(200, 0.2),
    "doubles as the window grows": 0.1 * (1 + np.clip((INTERVAL - 50) / 100, 0, 1)),
    "is higher from a larger window on": np.where(INTERVAL < 100, 0.15, 0.24),
}


def noisy(losses, seed=0, spread=0.3):
    """Medians of 50 steps, one of a hundred of them ten times as large, of log-normal noise."""
    draw = np.random.default_rng(seed)
    noise = draw.lognormal(0, spread, (len(losses), 50))
    return losses * np.median(noise * np.where(draw.random(noise.shape) < 0.01, 10, 1), 1)


def alarms(losses, band=None) -> list[int]:
    band = LossBand() if band is None else band
    return [index for index, loss in enumerate(losses) if band.leaves(float(loss))]


@pytest.mark.parametrize("name", CURVES)
def test_a_noisy_loss_stays_within_its_band(name):
    for seed in range(20):
        assert alarms(noisy(CURVES[name], seed)) == []


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("at", [5, 30, 120])
def test_a_divergence_is_told_once_within_two_intervals(name, at):
    since = np.clip(INTERVAL - at, -1, 50)
    for growth in (np.where(since < 0, 1, 5), 2.5 ** (since + 1)):
        found = alarms(noisy(CURVES[name] * growth))
        assert len(found) == 1 and found[0] - at in (0, 1)


def test_a_loss_that_returns_to_its_band_can_leave_it_again():
    losses = [0.2] * 10 + [0.9] * 2 + [0.2] * 5 + [float("nan"), 0.9, 0.9]
    assert alarms(losses) == [10, 18]


def test_the_warning_names_step_loss_band_and_remedy():
    trainer = Mock(lightning.Trainer, loggers=[], world_size=1, is_global_zero=True)
    module = Mock(SplattingModule, device=CPU, net=nn.ModuleDict())
    views = SimpleNamespace(num_views=1)
    batch = {"scene": ["a"], "inputs": views, "targets": views}
    watch = TrainingMonitor(every=2)

    def take(step: int, loss: float) -> None:
        trainer.global_step = step
        trainer.callback_metrics = {"train/loss": torch.tensor(loss)}
        watch.on_before_optimizer_step(trainer, module, Mock(torch.optim.Optimizer))
        watch.on_train_batch_end(trainer, module, None, batch)

    watch.on_train_start()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for step in range(1, 11):
            take(step, 0.25)
        resumed = TrainingMonitor(every=2)
        resumed.load_state_dict(watch.state_dict())
        watch = resumed
        watch.on_train_start()
        for step, loss in enumerate([0.75, 0.75, 3.0, 3.0, 3.0, float("inf")], 11):
            take(step, loss)
    (warning,) = said
    message = str(warning.message)
    assert message.startswith("step 12: the median loss of 2 steps is 0.75, and its band, ")
    assert "ends at 0.5;" in message and "init_path=.../checkpoints/best.ckpt" in message
