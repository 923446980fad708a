"""All kernels for CPUs with bounds checks, over random scenes and sequences, in memory as it comes
and in poisoned memory: the same bits and the same statistics.

The tests run this file as a program: NUMBA_BOUNDSCHECK=1 python tests/stress/test_checked.py
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numba
import numpy as np
import pytest
import torch
from backends import FAST, INTERPRETED, Result, assert_same_bits, both_ways
from poison import FILLS, poisoned
from tangents import tangent_scene
from torch import Tensor

from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.ops import image_loss, selective_scan, ssd
from asysplat.ops.simd.gathers import gather_pairs, gather_squares
from asysplat.ops.simd.threads import kernel
from asysplat.ops.simd.vectors import load, load_some, store, zeros
from asysplat.refinement.adam import VisibleAdam
from asysplat.rendering import Culling
from asysplat.rendering.cpu.math import sum_and_clear
from asysplat.scene import Cameras, Gaussians

CPU = FAST[0]
# Lengths around chunks of 32 and 64 tokens and a segment of 1024; odd widths and states.
SSD_SIZES = [(1, 1, 1, 1), (2, 63, 3, 5), (1, 65, 2, 16), (1, 200, 5, 20), (1, 1100, 3, 33)]
SCAN_SIZES = [(1, 1, 1), (2, 31, 16), (1, 33, 40), (3, 64, 17), (1, 257, 128)]
STATES = (1, 16, 20)
ONE, EIGHT, LAST = np.float32(1), np.float32(8), np.float32(15)


def wild_scene(seed: int, height: int, width: int, degree: int) -> tuple[Gaussians, Cameras]:
    """Points, giants and needles, around, behind and far off two scenes' two cameras each."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, *shape, generator=generator)

    count = 700
    gaussians = Gaussians(
        means=normal(count, 3) * 10 ** (1.5 * normal(count, 1)) + torch.tensor([0.0, 0, 3]),
        quats=normal(count, 4),
        scales=10 ** (2 * normal(count, 3) - 1.5),
        opacities=torch.rand(2, count, generator=generator),
        sh=normal(count, (degree + 1) ** 2, 3),
    )
    pinhole = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    poses = torch.eye(4).repeat(2, 2, 1, 1)
    poses[:, 1, :3, 3] = 0.3
    return gaussians, Cameras(pinhole.expand(2, 2, 3, 3), poses, height, width)


def scenes() -> Iterator[Callable[[], Result]]:
    for seed in range(3):
        yield partial(both_ways, CPU, *tangent_scene(30_000, 256, 256, seed))
    sizes = [(1, 1, 0), (13, 17, 3), (16, 16, 1), (33, 300, 2), (300, 15, 0)]
    for seed, (height, width, degree) in enumerate(sizes):
        masks = torch.zeros(2, 2, height, width, dtype=torch.bool)
        masks[..., : height // 2] = True
        options = [{"antialiased": True}, {"depth": "median"}, {"masks": masks}]
        for name in ("ellipse", "extent", "frustum", "rows", "opaque"):
            options.append({"culling": Culling(**{name: False})})
        for option in options:
            yield partial(both_ways, CPU, *wild_scene(seed, height, width, degree), **option)


def ssds() -> Iterator[Callable[[], Result]]:
    for size, state, reverse in product(SSD_SIZES, STATES, (False, True)):
        yield partial(scanned, ssd, size, state, reverse)


def selective_scans() -> Iterator[Callable[[], Result]]:
    for size, state, reverse in product(SCAN_SIZES, STATES, (False, True)):
        yield partial(scanned, selective_scan, size, state, reverse)


def scanned(scan, size: tuple[int, ...], state: int, reverse: bool) -> Result:
    generator = torch.Generator().manual_seed(len(size))

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    batch, length, channels = size[:3]
    inputs = {
        "x": normal(*size),
        "dt": normal(batch, length, channels).exp(),
        "A": -normal(*((channels,) if scan is ssd else (channels, state))).exp(),
        "B": normal(batch, length, state),
        "C": normal(batch, length, state),
        "D": normal(channels),
    }
    leaves = [tensor.requires_grad_() for tensor in inputs.values()]
    y = scan(*leaves, backend="cpu", reverse=reverse)
    grads = torch.autograd.grad(y, leaves, torch.linspace(-1, 1, y.numel()).view(y.shape))
    return Result({"y": y.detach()}, dict(zip(inputs, grads, strict=True)), {})


def sweeps() -> Iterator[Callable[[], Result]]:
    sizes = [(1, 1, 1, 4), (3, 4, 1, 20), (12, 9, 3, 33), (7, 37, 1, 17), (24, 32, 2, 64)]
    for seed, (height, width, stride, planes) in enumerate(sizes):
        generator = torch.Generator().manual_seed(seed)
        images = torch.rand(2, 4, 3, height, width, generator=generator)
        angles = torch.randn(2, 4, 3, 3, generator=generator)
        poses = torch.eye(4).repeat(2, 4, 1, 1)
        poses[..., :3, :3] = torch.linalg.matrix_exp(0.2 * (angles - angles.mT))
        poses[..., :3, 3] = torch.randn(2, 4, 3, generator=generator)
        pinhole = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        cameras = Cameras(pinhole.expand(2, 4, 3, 3), poses, height, width)
        yield partial(swept, images, cameras, stride, planes)


def swept(images: Tensor, cameras: Cameras, stride: int, planes: int) -> Result:
    return Result(vars(plane_sweep(images, cameras, stride, planes, backend="cpu")), {}, {})


def losses() -> Iterator[Callable[[], Result]]:
    sizes = [(1, 1), (10, 40), (11, 11), (12, 16), (64, 27), (65, 33), (140, 100)]
    for (height, width), grad in product(sizes, (False, True)):
        yield partial(compared, height, width, grad)


def compared(height: int, width: int, grad: bool) -> Result:
    generator = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(2, 2, 3, height, width, generator=generator)
    loss = image_loss(rendered.requires_grad_(grad), target, backend="cpu")
    grads = torch.autograd.grad(loss.sum(), rendered) if grad else ()
    return Result({"loss": loss.detach()}, dict(zip(["rendered"], grads, strict=False)), {})


def optimizers() -> Iterator[Callable[[], Result]]:
    for rows in (0, 1, 17, 1023, 1025, 2100):
        yield partial(stepped, rows)


def stepped(num: int) -> Result:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "opacities": (), "sh": (4, 3), "more": (16, 3)}

    def normal() -> dict[str, Tensor]:
        return {name: torch.randn(num, *s, generator=generator) for name, s in shapes.items()}

    optimizer, rates = VisibleAdam(normal()), dict.fromkeys(shapes, 0.1)
    for _ in range(3):
        gradients = normal()
        gradients["sh"][::100] = torch.nan
        optimizer.step(gradients, rates, torch.rand(num, generator=generator) < 0.5)
    state = {f"{n}.{part}": t for n, parts in optimizer._state.items() for part, t in parts.items()}
    return Result(optimizer.parameters | state, {}, {"non_finite": optimizer.non_finite})


def check_in_all_memories(run: Callable[[], Result]) -> None:
    plain = run()
    for fill in FILLS:
        with poisoned(fill):
            found = run()
        assert_same_bits(found, plain)
        assert found.stats == plain.stats


@kernel
def _step_out(which, numbers, rows):
    if which == 0:
        numbers[len(numbers)] = 1
    elif which == 1:
        sum_and_clear(numbers, len(numbers) - 15)
    elif which == 2:
        store(rows, len(rows), load(rows, 0))
    elif which == 3:
        store(rows, 0, load_some(numbers, len(numbers) - 3, 4))
    elif which == 4:  # the last number has none to its right,
        store(rows, 0, gather_squares(rows, zeros(), zeros() + LAST)[0])
    elif which == 5:  # and none below
        store(rows, 0, gather_squares(rows, zeros() + ONE, zeros())[0])
    elif which == 6:
        store(rows, 0, gather_pairs(numbers.reshape(2, 8, 2), zeros() + ONE, zeros() + EIGHT)[0])


GROUPS = {f.__name__: f for f in (selective_scans, sweeps, losses, optimizers, ssds, scenes)}


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="kernels for GPUs are interpreted there")
@pytest.mark.skipif(sys.platform != "linux", reason="memory is poisoned by glibc")
@pytest.mark.parametrize(
    "groups",
    [
        ("selective_scans", "sweeps", "losses", "optimizers"),
        pytest.param(("ssds", "scenes"), marks=pytest.mark.slow),  # a minute of compiling
    ],
    ids="-".join,
)
def test_kernels_with_bounds_checks_and_in_poisoned_memory(groups):
    done = subprocess.run(
        [sys.executable, __file__, *groups],
        env={**os.environ, "NUMBA_BOUNDSCHECK": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("the same bits") == len(groups)


if __name__ == "__main__":
    assert numba.config.BOUNDSCHECK, "set NUMBA_BOUNDSCHECK=1"
    for which in range(7):
        try:
            _step_out(which, np.zeros(32, np.float32), np.zeros((2, 16), np.float32))
        except IndexError:
            continue
        raise AssertionError(f"step {which} out of an array went unseen")
    for name in sys.argv[1:] or GROUPS:
        runs = list(GROUPS[name]())
        for run in runs:
            check_in_all_memories(run)
        print(f"{len(runs)} {name}, {len(FILLS) + 1} memories: the same bits", flush=True)
