"""What rendering and refinement ask of a GPU: operators of torch, kernels, and waiting of the host.

No GPU is needed: operators run on a CPU, and our kernels are recorded instead of run. A GPU waits
for the host where each takes microseconds, and the host for it where a number or a length is read.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from asysplat.errors import InputError
from asysplat.ops.image_loss import image_loss
from asysplat.refinement import DEFAULT, Refinement
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views
from benchmarks.compare import Kind, TrackedMetrics
from benchmarks.table import make_table, number_column, text_column
from benchmarks.timing import Result

TRACKED = TrackedMetrics(
    names=("case",), must_match=(), kinds={"launches": Kind("launches", "slower", "faster", 0.0)}
)
NOTES = """\
operators: of torch, without those that only view or allocate; a sort is one, and several kernels; \
kernels: ours; waits: where the host reads from the device, or copies numbers to it"""
# Operators that launch nothing.
FREE = {"view", "_unsafe_view", "expand", "permute", "transpose", "t", "slice", "select", "unbind"}
FREE |= {"unsqueeze", "squeeze", "detach", "alias", "as_strided", "split", "split_with_sizes"}
FREE |= {"diagonal", "unfold", "_reshape_alias", "is_same_size", "unflatten", "promote_types"}
FREE |= {"empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided"}
# Results whose values or sizes the host needs; and a tensor made of the host's numbers, a copy.
READ = {"lift_fresh", "_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal"}
BY_MASK = {"index", "index_put_", "_index_put_impl_"}  # if an index is boolean
COPIES = {Tensor.tolist, Tensor.cpu, Tensor.numpy}


@dataclass
class Counts:
    """Numbers of operators, of waits, and of recorded kernels."""

    operators: int = 0
    waits: int = 0
    kernels: int = 0

    def row(self, case: str) -> Result:
        """Return the counts as a row of the results."""
        return {"case": case, "launches": self.operators + self.kernels} | vars(self)


class _Operators(TorchDispatchMode):
    def __init__(self, counts: Counts):
        super().__init__()
        self.counts, self.paused = counts, False

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        name = operator.overloadpacket.__name__
        masks = args[1] if name in BY_MASK else ()
        by_mask = any(index is not None and index.dtype == torch.bool for index in masks)
        if not self.paused:
            self.counts.operators += name not in FREE
            self.counts.waits += name in READ or by_mask
        return operator(*args, **(kwargs or {}))


class _Copies(TorchFunctionMode):
    def __init__(self, counts: Counts):
        super().__init__()
        self.counts = counts

    def __torch_function__(self, function, types, args=(), kwargs=None):
        self.counts.waits += function in COPIES
        return function(*args, **(kwargs or {}))


class Recorder(NamedTuple):
    """Recorded launches, and functions that write their results."""

    launches: list[Any]
    fills: list[Callable[[dict[str, Any]], None]]

    @contextmanager
    def counting(self) -> Iterator[Counts]:
        """Count what a block asks for."""
        from benchmarks.machine_code.launches import keep_one_pair

        counts, before = Counts(), len(self.launches)
        operators = _Operators(counts)

        def fill(arguments: dict[str, Any]) -> None:
            operators.paused = True
            keep_one_pair(arguments)
            operators.paused = False

        self.fills[:] = [fill]
        with operators, _Copies(counts):
            yield counts
        counts.kernels = len(self.launches) - before


@contextmanager
def as_on_a_gpu() -> Iterator[Recorder]:
    """Let the operators of a block choose the GPU's kernels, which are recorded."""
    from benchmarks.machine_code.launches import keep_one_pair, recording

    loss = partial(image_loss, backend="reference")
    with ExitStack() as stack:
        launches, fills = stack.enter_context(recording())
        fills[:] = [keep_one_pair]
        for place in ("asysplat.rendering.render", "asysplat.ops.adam"):
            stack.enter_context(patch(f"{place}.choose_fastest", lambda *_: "cuda"))
        stack.enter_context(patch("asysplat.refinement.refine.image_loss", loss))
        yield Recorder(launches, fills)


def measure(options: DictConfig, console: Console) -> Result:
    """Count the launches of a rendering, its gradient, and a step of a refinement.

    Returns:
        "rows": for each case the numbers of operators, kernels, both together, and waits.
    """
    if not find_spec("triton"):
        raise InputError("suite=launches needs Triton, which comes with torch on Linux.")
    with as_on_a_gpu() as recorder:
        return {"rows": [row for case in CASES for row in case(recorder)]}


def make_views(count: int) -> Views:
    lens = torch.tensor([[50.0, 0, 48], [0, 50, 32], [0, 0, 1]]).repeat(count, 1, 1)
    cameras = Cameras(lens, torch.eye(4).repeat(count, 1, 1), 64, 96)
    return Views(cameras, torch.full((count, 3, 64, 96), 0.5))


def make_gaussians(needed: bool) -> Gaussians:
    num = 2048
    fields = (torch.zeros(num, 3), torch.ones(num, 4), torch.ones(num, 3), torch.full((num,), 0.5))
    return Gaussians(*(field.requires_grad_(needed) for field in (*fields, torch.zeros(num, 4, 3))))


def _render(recorder: Recorder) -> list[Result]:
    cameras, gaussians = make_views(1).cameras, make_gaussians(needed=True)
    with recorder.counting() as forward, torch.no_grad():
        render(gaussians, cameras, depth=False)
    with recorder.counting() as kept:
        image = render(gaussians, cameras, depth=False).image
    gradient = torch.ones_like(image)
    with recorder.counting() as backward:
        torch.autograd.grad(image, list(vars(gaussians).values()), gradient)
    names = ("render", "render, with a graph", "its gradient")
    return [counts.row(name) for name, counts in zip(names, (forward, kept, backward), strict=True)]


def _step(recorder: Recorder) -> list[Result]:
    settings = replace(DEFAULT, half_resolution_until=0.0, densify="none")
    refinement = Refinement(make_gaussians(needed=False), make_views(4), settings=settings)
    refinement.step(0.0)  # the first one makes the optimizer's state, and sweeps for depths
    rows = []
    for name, progress in (("step of a refinement", 0.7), ("with known depths", 0.3)):
        with recorder.counting() as counts:
            refinement.step(progress)
        rows.append(counts.row(name))
    return rows


CASES: tuple[Callable[[Recorder], list[Result]], ...] = (_render, _step)


def tables(results: Result) -> list[Table]:
    """Show the counts."""
    return [make_table("Launches on a GPU", COLUMNS, results["rows"], NOTES)]


COLUMNS = {
    "": text_column("{case}"),
    "operators": number_column("operators", "{:,.0f}"),
    "kernels": number_column("kernels", "{:,.0f}"),
    "together": number_column("launches", "{:,.0f}"),
    "waits": number_column("waits", "{:,.0f}"),
}
