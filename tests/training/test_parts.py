"""Seconds of nested parts, of modules and of parallel threads."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, get_ident

import pytest
import torch
from test_side_by_side import make_batch, module, state  # noqa: F401
from torch import nn

from asysplat.training import parts as module_of_parts
from asysplat.training.parts import Parts

CPU = torch.device("cpu")


@pytest.fixture
def clock(monkeypatch):
    """A clock for each thread that only a test advances."""
    seconds = {}

    class Clock:
        @staticmethod
        def perf_counter():
            return seconds.get(get_ident(), 0.0)

        @staticmethod
        def wait(spent):
            seconds[get_ident()] = seconds.get(get_ident(), 0.0) + spent

    monkeypatch.setattr(module_of_parts, "time", Clock)
    return Clock


def test_an_inner_part_does_not_count_for_the_outer(clock):
    prior = nn.Identity()
    prior.register_forward_pre_hook(lambda *_: clock.wait(3))
    parts = Parts()
    parts.start(CPU)
    with parts("network"), parts.of("prior", prior):
        clock.wait(1)
        prior(torch.zeros(1))
        clock.wait(4)
    parts.add("data", 0.5)
    # The test's own hook, registered earlier, runs before the measurement.
    assert parts.stop() == {"network": 8, "prior": 0, "data": 0.5}
    assert len(prior._forward_pre_hooks) == 1 and not prior._forward_hooks


def test_a_module_is_measured_at_its_calls(clock):
    class Prior(nn.Module):
        def forward(self, x):
            clock.wait(3)
            return x

    parts, prior = Parts(), Prior()
    parts.start(CPU)
    with parts("network"), parts.of("prior", prior), parts.of("none", None):
        clock.wait(1)
        prior(prior(torch.zeros(1)))
    assert parts.stop() == {"network": 1, "prior": 6}


def test_seconds_of_parallel_threads_are_averaged(clock):
    parts, together = Parts(), Barrier(2)
    parts.start(CPU)

    def work(seconds):
        with parts("network"):
            together.wait(10)  # so that each has a thread of its own
            clock.wait(seconds)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, (2, 4)))
    with parts("loss"):
        clock.wait(7)
    assert parts.stop() == {"network": 3, "loss": 7}


def test_nothing_is_measured_before_start(clock):
    parts, prior = Parts(), nn.Identity()
    with parts("network"), parts.of("prior", prior):
        assert not prior._forward_hooks
        clock.wait(1)
    parts.start(CPU)
    assert parts.stop() == {}


def test_a_step_of_scenes_side_by_side(module):  # noqa: F811
    """All parts of a step are measured, and measuring does not change the result."""
    batch, found = make_batch(), []
    start = {name: buffer.clone() for name, buffer in module.net.named_buffers()}
    for measured in (True, False):
        module.net.load_state_dict(start, strict=False)
        module.zero_grad()
        if measured:
            module.parts.start(CPU)
        module._side_by_side(batch)["loss"].backward()
        found.append(state(module))
        if measured:
            seconds = module.parts.stop()
    assert seconds.keys() == {"prior", "network", "rendering", "loss", "backward"}
    assert min(seconds.values()) > 0
    assert all(torch.equal(tensor, found[1][name]) for name, tensor in found[0].items())
