"""What rendering and refinement ask of a GPU: operators of torch, kernels, waiting, and memory.

No GPU is needed: operators run on a CPU, and our kernels are recorded instead of run. A GPU waits
for the host where each takes microseconds, and the host for it where a number or a length is read.
"""

import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary

from asysplat.errors import InputError
from asysplat.refinement import DEFAULT, Refinement
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views
from benchmarks.compare import Kind, TrackedMetrics
from benchmarks.table import make_table, number_column, text_column
from benchmarks.timing import Result
from benchmarks.traffic import FREE, measure_blocks

TRACKED = TrackedMetrics(
    names=("case",), must_match=(), kinds={"launches": Kind("launches", "slower", "faster", 0.0)}
)
NOTES = """\
operators: of torch, without those that only view or allocate; a sort is one, and several kernels; \
kernels: ours; waits: where the host reads from the device, or copies numbers to it"""
MEMORY_NOTES = """\
MB of tensors besides the Gaussians, without what a sort allocates for itself; each Gaussian \
touches five tiles; kept: between both passes; peak: with the gradients of image and Gaussians"""
BLOCK_NOTES = """\
kB: what the operators of a forward pass in bf16 read and write for each token of the output, at \
the paper's widths; attention and a scan are one operator each"""
SCENES = {  # Gaussians, SH degree, height and width
    "100,000 Gaussians, 540x960": (100_000, 0, 540, 960),
    "1 million, 1080x1920": (1_000_000, 0, 1080, 1920),
    "5 million, 1080x1920, SH degree 3": (5_000_000, 3, 1080, 1920),
}
# Results whose values or sizes the host needs.
READ = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal"}
BY_MASK = {"index", "index_put_", "_index_put_impl_"}  # if an index is boolean
COPIES = {Tensor.tolist, Tensor.cpu, Tensor.numpy, Tensor.new_tensor}
TO_A_DEVICE = {torch.tensor, torch.as_tensor}  # copies, where a device is named


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
        self.counts.waits += function in TO_A_DEVICE and "device" in (kwargs or {})
        return function(*args, **(kwargs or {}))


class _Memory(TorchDispatchMode):
    """Counts the bytes of the storages that operators allocate, until they are freed."""

    def __init__(self):
        super().__init__()
        self.now = self.peak = 0
        self._seen = WeakIdKeyDictionary()  # storages

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        self._add_new((args, kwargs), counted=False)
        results = operator(*args, **(kwargs or {}))
        self._add_new(results, counted=True)
        return results

    def _add_new(self, values: object, counted: bool) -> None:
        for tensor in tree_leaves(values):
            storage = tensor.untyped_storage() if isinstance(tensor, Tensor) else None
            if storage is not None and storage not in self._seen:
                size = storage.nbytes() * counted
                self._seen[storage] = weakref.ref(storage, partial(self._add, -size))
                self._add(size)

    def _add(self, count: int, _: object = None) -> None:
        self.now += count
        self.peak = max(self.peak, self.now)


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

    with ExitStack() as stack:
        launches, fills = stack.enter_context(recording())
        fills[:] = [keep_one_pair]
        for place in ("rendering.render", "ops.adam", "ops.image_loss"):
            stack.enter_context(patch(f"asysplat.{place}.choose_fastest", lambda *_: "cuda"))
        yield Recorder(launches, fills)


def measure(options: DictConfig, console: Console) -> Result:
    """Count the launches of a rendering, its gradient, and a step of a refinement.

    Returns:
        "rows": for each case the numbers of operators, kernels, both together, and waits.
        "memory": for each of SCENES the bytes kept between both passes of a rendering, and most.
        "blocks": for each block of the paper's network its operators, and their bytes of a token.
    """
    if not find_spec("triton"):
        raise InputError("suite=launches needs Triton, which comes with torch on Linux.")
    with as_on_a_gpu() as recorder:
        rows = [row for case in CASES for row in case(recorder)]
        memory = [_memory(recorder, name) for name in SCENES]
    return {"rows": rows, "memory": memory, "blocks": measure_blocks()}


def make_views(count: int, height: int = 64, width: int = 96) -> Views:
    lens = torch.tensor([[50.0, 0, 48], [0, 50, 32], [0, 0, 1]]).repeat(count, 1, 1)
    cameras = Cameras(lens, torch.eye(4).repeat(count, 1, 1), height, width)
    return Views(cameras, torch.full((count, 3, height, width), 0.5))


def make_gaussians(needed: bool, num: int = 2048, degree: int = 1) -> Gaussians:
    fields = (torch.zeros(num, 3), torch.ones(num, 4), torch.ones(num, 3), torch.full((num,), 0.5))
    fields += (torch.zeros(num, (degree + 1) ** 2, 3),)
    return Gaussians(*(field.requires_grad_(needed) for field in fields))


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


def _memory(recorder: Recorder, name: str) -> Result:
    num, degree, height, width = SCENES[name]
    gaussians = make_gaussians(True, num, degree)
    cameras = make_views(1, height, width).cameras

    def fill(arguments: dict[str, Any]) -> None:
        recorder.launches.clear()  # they hold their tensors
        if arguments.get("WRITE") is False:
            arguments["counts"].fill_(5)
        elif "tile_of" in arguments:
            tile_of = arguments["tile_of"].numpy()  # so that nothing here is counted
            tile_of[:] = np.linspace(0, arguments["tiles"] - 1, len(tile_of))

    recorder.fills[:] = [fill]
    with _Memory() as memory:
        image = render(gaussians, cameras, depth=False).image
        kept = memory.now
        torch.autograd.grad(image, list(vars(gaussians).values()), torch.ones_like(image))
    return {"scene": name, "kept": kept, "peak": memory.peak}


CASES: tuple[Callable[[Recorder], list[Result]], ...] = (_render, _step)


def tables(results: Result) -> list[Table]:
    """Show the counts."""
    return [
        make_table("Launches on a GPU", COLUMNS, results["rows"], NOTES),
        make_table("Memory of both passes", MEMORY_COLUMNS, results["memory"], MEMORY_NOTES),
        make_table("Blocks of the network", BLOCK_COLUMNS, results["blocks"], BLOCK_NOTES),
    ]


COLUMNS = {
    "": text_column("{case}"),
    "operators": number_column("operators", "{:,.0f}"),
    "kernels": number_column("kernels", "{:,.0f}"),
    "together": number_column("launches", "{:,.0f}"),
    "waits": number_column("waits", "{:,.0f}"),
}
MEMORY_COLUMNS = {
    "": text_column("{scene}"),
    "kept": number_column("kept", "{:,.0f}", unit=1e6),
    "peak": number_column("peak", "{:,.0f}", unit=1e6),
}
BLOCK_COLUMNS = {
    "": text_column("{block}"),
    "operators": number_column("operators", "{:,.0f}"),
    "kB": number_column("bytes", "{:,.1f}", unit=1e3),
}
