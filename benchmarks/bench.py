"""Small workloads, timed relative to baselines: ratios that a code change must not raise."""

import math
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch.utils._python_dispatch import TorchDispatchMode

from asysplat.ops.adam.cpu import adam_step_cpu
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference
from asysplat.ops.image_loss import image_loss
from asysplat.ops.ssd.reference import CHUNK
from asysplat.refinement import Refinement
from asysplat.scene import Views
from benchmarks.compare import RATIO, TrackedMetrics
from benchmarks.model import Workload, make_net, make_views
from benchmarks.ops import make_path
from benchmarks.options import CPU
from benchmarks.render import Backend, prepare_inputs, run_passes
from benchmarks.scenes import random_scene
from benchmarks.table import machine_note, make_table, median_iqr_column, text_column
from benchmarks.timing import Measurement, Result, Run, summarize, time_in_rounds

aten = torch.ops.aten
BEST_OF = 3  # runs in a round, of which the fastest counts: interruptions only slow a run down
TRACKED = TrackedMetrics(names=("workload", "baseline_name"), must_match=(), kinds={"ratio": RATIO})
OPERATORS = {  # baseline backend, and sizes of the inputs
    "ssd": ("chunked", {"batch": 1, "length": 512, "heads": 4, "head_dim": 64, "state": 64}),
    "selective_scan": ("chunked", {"batch": 8, "length": 128, "channels": 64, "state": 16}),
    "plane_sweep": (
        "reference",
        {"batch": 1, "views": 4, "height": 32, "width": 32} | {"planes": 48, "neighbors": 3},
    ),
}
GAUSSIANS, SIDE = 5000, 96  # size of the renderer's scene, and side of its image in pixels
PRODUCTS = {
    call.default for call in (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.convolution)
}
ROWS = 20_000  # rows of parameters, half of which Adam updates
NETWORK, VIEWS, VIEW_SIDE = "asysplat_4m4s", 4, 64


class Pair(NamedTuple):
    """A workload and the baseline that its time is divided by."""

    name: str
    baseline_name: str
    workload: Run
    baseline: Run


def make_pairs() -> Iterator[Pair]:
    """Make all pairs, with the same numbers at every call."""
    for name, (baseline_name, sizes) in OPERATORS.items():
        backends = ("cpu", baseline_name)
        paths = [make_path(name, sizes, backend, torch.float32, CPU) for backend in backends]
        yield Pair(name, baseline_name, *(path.forward_backward for path in paths))

    # Both passes of the renderer, and a step of the refinement
    gaussians, camera = random_scene(GAUSSIANS, SIDE, SIDE)
    inputs = prepare_inputs((gaussians, camera))
    passes = {name: partial(run_passes, Backend(name), inputs) for name in ("cpu", "reference")}
    yield Pair("render", "reference", passes["cpu"], passes["reference"])
    generator = torch.Generator().manual_seed(0)
    photograph = Views(camera, torch.rand(1, 3, SIDE, SIDE, generator=generator))
    refinement = Refinement(gaussians, photograph)
    yield Pair("refinement", "reference", lambda: refinement.step(1.0), passes["reference"])

    generator = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(2, 3, 2 * SIDE, 2 * SIDE, generator=generator)
    rendered.requires_grad_()

    def loss_passes(backend: str) -> None:
        torch.autograd.grad(image_loss(rendered, target, backend=backend), rendered)

    losses = [partial(loss_passes, name) for name in ("cpu", "reference")]
    yield Pair("image_loss", "reference", *losses)

    generator = torch.Generator().manual_seed(0)
    visible = torch.rand(ROWS, generator=generator) < 0.5
    steps = []
    for step in (adam_step_cpu, adam_step_reference):
        # Parameters, gradients and both averages; a mean square is not negative
        numbers = torch.rand(4, ROWS, 12, generator=generator)
        rows = Rows(*numbers, torch.zeros(ROWS, dtype=torch.int32), torch.full((12,), 1e-3))
        steps.append(partial(step, [rows], visible, AdamSettings(0.9, 0.999, 1e-15)))
    yield Pair("adam", "reference", *steps)

    # A forward pass and its matrix products and convolutions
    net, _ = make_net(NETWORK, {"scale": "laptop"}, CPU)
    workload = Workload(net, "fp32", make_views(1, VIEWS, VIEW_SIDE, VIEW_SIDE, CPU))
    with RecordProducts() as products:
        workload.forward()
    yield Pair(NETWORK, "products", workload.forward, products.run)


class RecordProducts(TorchDispatchMode):
    """The matrix products and convolutions called in a context, those in attention and SSD too."""

    def __init__(self):
        super().__init__()
        self.calls: list[Run] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        sizes = []  # b, m, k, n of products [b, m, k] x [b, k, n]
        if func in PRODUCTS:
            self.calls.append(partial(func, *args))
        elif func._schema.name.startswith("aten::_scaled_dot_product"):
            *batch, queries, head_dim = args[0].shape
            heads, keys = math.prod(batch), args[1].shape[-2]
            sizes = [(heads, queries, head_dim, keys), (heads, queries, keys, head_dim)]
        elif func._schema.name == "asysplat::ssd":
            (batch, length, heads, head_dim), state = args[1].shape, args[4].shape[-1]
            chunks, inner = batch * -(-length // CHUNK), heads * head_dim
            # Scores, scores x inputs, the update of the state, and the output from the state
            sizes = [(chunks, CHUNK, state, CHUNK), (chunks * heads, CHUNK, CHUNK, head_dim)]
            sizes += [(chunks, state, CHUNK, inner), (chunks, CHUNK, state, inner)]
        for b, m, k, n in sizes:
            self.calls.append(partial(torch.bmm, torch.randn(b, m, k), torch.randn(b, k, n)))
        return func(*args, **(kwargs or {}))

    @torch.no_grad()
    def run(self) -> None:
        for call in self.calls:
            call()


def measure(options: DictConfig, console: Console) -> Result:
    """Time every workload and its baseline one after the other, in `options.repeats` rounds.

    Times are processor times on one thread, so that other programs on the machine do not count.

    Returns:
        "rows": the "seconds" of each workload and of its "baseline", and the "ratio" of both in the
        same round.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        pairs = list(make_pairs())
        rounds = [Measurement(partial(_time_pair, pair)) for pair in pairs]
        time_in_rounds(rounds, options.repeats, console)
    finally:
        torch.set_num_threads(threads)
    rows = []
    for pair, timed in zip(pairs, rounds, strict=True):
        seconds, baseline = timed.seconds["workload"], timed.seconds["baseline"]
        row = {"workload": pair.name, "baseline_name": pair.baseline_name}
        row |= {"seconds": summarize(seconds), "baseline": summarize(baseline)}
        ratios = [a / b for a, b in zip(seconds, baseline, strict=True)]
        rows.append(row | {"ratio": summarize(ratios)})
    return {"rows": rows}


def _time_pair(pair: Pair) -> dict[str, float]:
    """Return the least processor time of BEST_OF runs of the workload and of the baseline."""
    seconds = {}
    for name in ("workload", "baseline"):
        times = [time.process_time()]
        for _ in range(BEST_OF):
            getattr(pair, name)()
            times.append(time.process_time())
        seconds[name] = min(end - start for start, end in pairwise(times))
    return seconds


def tables(results: Result) -> list[Table]:
    """Show the ratio of each workload to its baseline."""
    columns = {
        "workload": text_column("{workload}"),
        "baseline": text_column("its {baseline_name}"),
        "ms": median_iqr_column("seconds", "{:.2f}"),
        "baseline\nms": median_iqr_column("baseline", "{:.2f}"),
        "ratio": median_iqr_column("ratio", "{:.3f}", unit=1.0),
    }
    notes = (
        f"{machine_note(results)}\n"
        f"one thread, processor time, the best of {BEST_OF} runs in each round"
    )
    return [make_table("Ratios to a baseline", columns, results["rows"], notes, names=2)]
