"""Small workloads, each with a yardstick: the same by a reference, or the matrix products in it."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import torch

from asysplat.benchmark.model.components import record_products
from asysplat.benchmark.model.workload import Workload, make_net, make_views
from asysplat.benchmark.ops.cases import Case
from asysplat.benchmark.ops.paths import make_path
from asysplat.benchmark.ops.sweep import SweepCase
from asysplat.benchmark.render.run import Backend, prepare, run
from asysplat.benchmark.scenes import random_scene
from asysplat.ops.adam.cpu import adam_step_cpu
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference
from asysplat.ops.image_loss import image_loss
from asysplat.refinement import Refinement
from asysplat.rendering import Culling
from asysplat.scene import Views

CPU = torch.device("cpu")
CASES = {
    "chunked": (
        Case("ssd", {"batch": 1, "length": 512, "heads": 4, "head_dim": 64, "state": 64}),
        Case("selective_scan", {"batch": 8, "length": 128, "channels": 64, "state": 16}),
    ),
    "reference": (
        SweepCase(
            "plane_sweep",
            {
                "batch": 1,
                "views": 4,
                "height": 32,
                "width": 32,
                "stride": 2,
                "planes": 48,
                "neighbors": 3,
            },
        ),
    ),
}
GAUSSIANS, SIDE = 5000, 96  # of the renderer's scene
ROWS = 20_000  # that Adam updates half of
NETWORK, VIEWS, VIEW_SIDE = "asysplat_plane_sweep", 4, 64

Run = Callable[[], object]


class Pair(NamedTuple):
    """A workload and its yardstick."""

    name: str
    over: str  # what the yardstick is
    workload: Run
    yardstick: Run


def make_pairs() -> Iterator[Pair]:
    """Make all pairs; the same numbers at every call."""
    for over, cases in CASES.items():
        for case in cases:
            paths = [make_path(case, name, torch.float32, CPU) for name in ("cpu", over)]
            yield Pair(case.name, over, *(path.forward_backward for path in paths))
    yield from _renderer()
    yield _image_loss()
    yield _adam()
    yield _network()


def _renderer() -> Iterator[Pair]:
    """Pair both passes of the renderer, and a step of the refinement, with the reference's."""
    gaussians, camera = random_scene(GAUSSIANS, SIDE, SIDE)
    inputs = prepare((gaussians, camera), "cpu")
    fast, reference = (
        partial(run, Backend(name, "cpu"), Culling(), inputs) for name in ("cpu", "reference")
    )
    yield Pair("render", "reference", fast, reference)
    generator = torch.Generator().manual_seed(0)
    photograph = Views(camera, torch.rand(1, 3, SIDE, SIDE, generator=generator))
    refinement = Refinement(gaussians, photograph)
    yield Pair("refinement", "reference", lambda: refinement.step(1.0), reference)


def _image_loss() -> Pair:
    generator = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(2, 3, 2 * SIDE, 2 * SIDE, generator=generator)
    rendered.requires_grad_()

    def both_passes(backend: str) -> None:
        loss = image_loss(rendered, target, backend=backend)
        torch.autograd.grad(loss, rendered)

    works = [partial(both_passes, name) for name in ("cpu", "reference")]
    return Pair("image_loss", "reference", *works)


def _adam() -> Pair:
    generator = torch.Generator().manual_seed(0)
    seen = torch.rand(ROWS, generator=generator) < 0.5
    settings = AdamSettings(0.9, 0.999, 1e-15)
    works = []
    for step in (adam_step_cpu, adam_step_reference):
        numbers = torch.rand(4, ROWS, 12, generator=generator)  # mean and square: above 0
        rows = Rows(*numbers, torch.zeros(ROWS, dtype=torch.int32), torch.full((12,), 1e-3))
        works.append(partial(step, [rows], seen, settings))
    return Pair("adam", "reference", *works)


def _network() -> Pair:
    """Pair a forward pass with its matrix products and convolutions."""
    net, _ = make_net(NETWORK, {"scale": "laptop"}, CPU)
    workload = Workload(NETWORK, net, "fp32", make_views(VIEWS, VIEW_SIDE, VIEW_SIDE, CPU))
    counts = record_products(workload.forward)["forward"]
    calls = [product.prepare(CPU) for product, count in counts.items() for _ in range(count)]

    def run_products() -> None:
        for call in calls:
            call()

    return Pair(NETWORK, "products", workload.forward, run_products)
