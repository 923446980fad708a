"""Measure the seconds of each part of a training step."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import get_ident
from typing import Any

import torch
from torch import nn

from asysplat.evaluation.measured_cost import wait_for

PARTS = ("data", "prior", "network", "rendering", "loss", "backward", "optimizer")


@dataclass
class _Thread:
    """The seconds of each part in one thread, and of the parts inside each open part."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    inner: list[float] = field(default_factory=list)


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
        open_parts = []

        def begin(*_: Any) -> None:
            open_parts.append(self(name))
            open_parts[-1].__enter__()

        def end(*_: Any) -> None:
            open_parts.pop().__exit__(None, None, None)

        hooks = (module.register_forward_pre_hook(begin), module.register_forward_hook(end))
        try:
            yield
        finally:
            for hook in hooks:
                hook.remove()

    def _now(self) -> float:
        wait_for(self.device)
        return time.perf_counter()
