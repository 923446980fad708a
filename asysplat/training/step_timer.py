"""Measure the seconds of each part of a training step."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from threading import get_ident

import torch

from asysplat.evaluation.measured_cost import wait_for

PARTS = ("data", "network", "rendering", "loss", "backward", "optimizer")


class StepTimer:
    """Measures the parts of a step between `start` and `stop`; in other steps it costs nothing.

    Parts do not overlap within a thread. Seconds of parallel threads are averaged. A part waits for
    the GPU where it begins and ends.
    """

    def __init__(self):
        self.measuring = False

    def start(self, device: torch.device) -> None:
        """Start measuring work on `device`."""
        self.device, self.measuring = device, True
        self._main = get_ident()
        self._threads: dict[int, dict[str, float]] = defaultdict(lambda: dict.fromkeys(PARTS, 0.0))

    def stop(self) -> dict[str, float]:
        """Stop measuring, and return the seconds of each of PARTS."""
        self.measuring = False
        seconds = self._threads.pop(self._main, dict.fromkeys(PARTS, 0.0))
        for thread in self._threads.values():
            for name, spent in thread.items():
                seconds[name] += spent / len(self._threads)
        return seconds

    def add(self, name: str, seconds: float) -> None:
        """Add seconds measured elsewhere."""
        self._threads[get_ident()][name] += seconds

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure the body as the part `name`."""
        if not self.measuring:
            yield
            return
        wait_for(self.device)
        started = time.perf_counter()
        yield
        wait_for(self.device)
        self.add(name, time.perf_counter() - started)
