"""The seconds of a training step, part by part."""

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
    """What one thread measured, and how long the parts inside of those that are open took."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    inner: list[float] = field(default_factory=list)


class Parts:
    """Measures the parts of a step between `start` and `stop`; in other steps it costs nothing.

    A part within a part is its own: its seconds are not those of the outer one. Of threads that
    work side by side, the mean counts. A GPU is waited for where a part begins and ends.
    """

    def __init__(self):
        self.measuring = False

    def start(self, device: torch.device) -> None:
        """Measure from now on what is computed on `device`."""
        self.device, self.measuring = device, True
        self._own = get_ident()
        self._threads: dict[int, _Thread] = defaultdict(_Thread)

    def stop(self) -> dict[str, float]:
        """Stop measuring, and return the seconds of each part."""
        self.measuring = False
        seconds = self._threads.pop(self._own, _Thread()).seconds
        for thread in self._threads.values():
            for name, spent in thread.seconds.items():
                seconds[name] += spent / len(self._threads)
        return dict(seconds)

    def add(self, name: str, seconds: float) -> None:
        """Add seconds that were measured otherwise."""
        self._threads[get_ident()].seconds[name] += seconds

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure what is done inside as the part `name`."""
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
        """Measure the calls of a module that are made inside; None measures nothing."""
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
