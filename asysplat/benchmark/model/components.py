"""What a forward pass is made of: layers by their kind, and the operators within them."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest import mock

from torch import nn

from asysplat import models
from asysplat.benchmark.model.task import Task
from asysplat.benchmark.products import Product, RecordProducts
from asysplat.benchmark.timing import seconds_of
from asysplat.evaluation.measured_cost import wait_for
from asysplat.models.tokenizer import Tokenizer

COMPONENTS = {  # none within another
    "tokenizer": (Tokenizer,),
    "Mamba2": (models.BiMamba2,),
    "sparse attention": (models.SparseAttention,),
    "full attention": (models.FullAttention,),
    "MambaVision": (models.MambaVision,),
    "cross-attention": (models.CoarseReadsFine, models.FineReadsCoarse),
    "head": (models.GaussianHead,),
}
OTHERS = "others"
OPERATORS = {  # and the layers' module that calls it
    "ssd": "asysplat.models.mamba2",
    "selective_scan": "asysplat.models.mamba_vision",
    "grid_attention": "asysplat.models.attention",
}


def component_seconds(task: Task) -> dict[str, float]:
    """Seconds that one forward pass spends in each of COMPONENTS, in OTHERS, and, once more, in
    each of OPERATORS."""
    watch = _Stopwatch(task.device)
    with _hooked(task.net, watch.start, watch.stop), ExitStack() as stack:
        for name, module in OPERATORS.items():
            stack.enter_context(watch.around(name, module))
        total = seconds_of(task.forward, task.device)
    watch.seconds[OTHERS] = total - sum(watch.seconds.get(name, 0) for name in COMPONENTS)
    return watch.seconds


def record_products(task: Task) -> dict[str, Counter[Product]]:
    """The products of one forward pass, by component."""
    recorder = RecordProducts(OTHERS)

    def enter(name: str) -> None:
        recorder.label = name

    def leave(name: str) -> None:
        recorder.label = OTHERS

    with _hooked(task.net, enter, leave), recorder:
        task.forward()
    return recorder.counts


class _Stopwatch:
    def __init__(self, device):
        self.device = device
        self.started: dict[str, float] = {}
        self.seconds: dict[str, float] = {}

    def start(self, name: str) -> None:
        self.started[name] = self._now()

    def stop(self, name: str) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + self._now() - self.started[name]

    def around(self, name: str, module: str) -> Any:
        """The function of this name replaced by one that is timed."""
        function = getattr(import_module(module), name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self.start(name)
            output = function(*args, **kwargs)
            self.stop(name)
            return output

        return mock.patch(f"{module}.{name}", timed)

    def _now(self) -> float:
        wait_for(self.device)
        return time.perf_counter()


@contextmanager
def _hooked(
    net: nn.Module, before: Callable[[str], None], after: Callable[[str], None]
) -> Iterator[None]:
    """`before` and `after` are called with the name of every component that runs."""
    hooks = []
    for module in net.modules():
        for name, kinds in COMPONENTS.items():
            if isinstance(module, kinds):
                hooks.append(module.register_forward_pre_hook(lambda *_, name=name: before(name)))
                hooks.append(module.register_forward_hook(lambda *_, name=name: after(name)))
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
