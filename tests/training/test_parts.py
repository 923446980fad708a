"""Seconds of the parts of a step, also of parallel threads."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, get_ident

import pytest
import torch

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


def test_seconds_of_parallel_threads_are_averaged(clock):
    parts, together = Parts(), Barrier(2)
    with parts("network"):  # before the start
        clock.wait(1)
    parts.start(CPU)
    parts.add("data", 0.5)

    def work(seconds):
        with parts("network"):
            together.wait(10)  # so that each has a thread of its own
            clock.wait(seconds)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, (2, 4)))
    with parts("loss"):
        clock.wait(7)
    seconds = {name: spent for name, spent in parts.stop().items() if spent}
    assert seconds == {"network": 3, "loss": 7, "data": 0.5}
