"""Measure the seconds of each part of a training step."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import get_ident

import torch
from torch import nn

from asysplat.evaluation.measured_cost import wait_for

PARTS = ("data", "prior", "network", "rendering", "loss", "backward", "optimizer")


class _Thread:
    def __init__(self):
        self.seconds: dict[str, float] = defaultdict(float)  # of each part
        self.inner: list[float] = []  # seconds of the parts inside each open part


class Parts:
    """Measures the parts of a step between `start` and `stop`; in other steps it costs nothing.

    The seconds of an inner part do not count for the outer one. Seconds of parallel threads are
    averaged. A part waits for the GPU where it begins and ends.
    """

    def __init__(self):
        self.measuring = False

    def start(self, device: torch.device) -> None:
        """Start measuring work on `device`."""
        self.device, self.measuring = device, True
        self._main = get_ident()
        self._threads: dict[int, _Thread] = defaultdict(_Thread)

    def stop(self) -> dict[str, float]:
        """Stop measuring, and return the seconds of each part."""
        self.measuring = False
        seconds = self._threads.pop(self._main, _Thread()).seconds
        for thread in self._threads.values():
            for name, spent in thread.seconds.items():
                seconds[name] += spent / len(self._threads)
        return dict(seconds)

    def add(self, name: str, seconds: float) -> None:
        """Add seconds measured elsewhere."""
        self._threads[get_ident()].seconds[name] += seconds

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure the body as the part `name`."""
        if not self.measuring:
            yield
            return
        thread = self._threads[get_ident()]
        thread.inner.append(0.0)
        started = self._now()
        try:
            yield
        finally:
            spent = self._now() - started
            thread.seconds[name] += spent - thread.inner.pop()
            if thread.inner:
                thread.inner[-1] += spent

    @contextmanager
    def of(self, name: str, module: nn.Module | None) -> Iterator[None]:
        """Measure the module's calls in the body; None measures nothing."""
        if not self.measuring or module is None:
            yield
            return
        part = ExitStack()
        begin = module.register_forward_pre_hook(lambda *_: part.enter_context(self(name)))
        end = module.register_forward_hook(lambda *_: part.close())
        try:
            yield
        finally:
            begin.remove()
            end.remove()

    def _now(self) -> float:
        wait_for(self.device)
        return time.perf_counter()
