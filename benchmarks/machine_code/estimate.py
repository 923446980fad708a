"""Milliseconds of the renderer's kernels on GPUs that are not at hand, estimated.

A kernel takes as long as its slowest resource: issuing instructions, one of the units that execute
them, or memory, if every array is read and written once. Waiting, which occupancy hides, is left
out.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import torch

from asysplat.rendering.cuda.draw import (
    BACKWARD_BLOCK,
    BACKWARD_STEP,
    BLOCK,
    ENTRY_BLOCK,
    FORWARD_STEP,
    SUM_BLOCK,
)
from asysplat.rendering.cuda.project_backward import PAIRS
from asysplat.rendering.cuda.splat import GRADIENT, SPLAT, TILE
from asysplat.rendering.interface import RenderSettings
from asysplat.rendering.reference.project import project
from asysplat.rendering.reference.tiles import list_tiles
from benchmarks.machine_code.cubin import Usage
from benchmarks.scenes import Scene

NUMBER = 4  # bytes of a float32
ISSUED = 4  # instructions of warps that a multiprocessor issues in a clock
# Instructions of warps that the other units of a multiprocessor take in a clock (CUDA C++
# Programming Guide, "Arithmetic Instructions"); float64 is a card's own.
UNITS = {"special": 0.5, "memory": 1.0}


class Card(NamedTuple):
    """A GPU, by its data sheet."""

    capability: int
    multiprocessors: int
    clock: float  # Hz, boost
    bandwidth: float  # bytes/s
    float64: float  # instructions of warps that a multiprocessor takes in a clock


CARDS = {
    "A100": Card(80, 108, 1.41e9, 1.555e12, 1.0),
    "RTX 4090": Card(89, 128, 2.52e9, 1.008e12, 1 / 16),
    "H200": Card(90, 132, 1.98e9, 4.8e12, 2.0),
}


class RenderingWork(NamedTuple):
    """What the kernels of the renderer do for one image: programs, rounds of loops, and bytes.

    The first of a kernel's rounds is 1, for the instructions outside of its loops.
    """

    programs: dict[str, int]
    rounds: dict[str, tuple[float, ...]]
    bytes: dict[str, float]
    pairs: int  # pairs of splat and tile


@torch.no_grad()
def measure_work(scene: Scene) -> RenderingWork:
    """Project a scene and list its tiles, by the reference, to count programs and rounds."""
    gaussians, cameras = (part.map(lambda tensor: tensor[None]) for part in scene)
    splats = project(gaussians, cameras, RenderSettings(depth=None))
    lists = list_tiles(splats, 1, cameras.height, cameras.width, TILE.value)
    num, visible, pairs = gaussians.num_gaussians, len(splats.images), len(lists.splats)
    spans = splats.last // TILE.value - splats.first // TILE.value + 1  # in order of depth
    rows = _mean_of_largest(spans[:, 1], BLOCK)
    columns = _mean_of_largest(spans[:, 0], BLOCK)
    counts = _mean_of_largest(spans.prod(-1), SUM_BLOCK)
    tiles, lengths = len(lists.lengths), lists.lengths.double()
    fields = 11 + gaussians.sh.shape[-2] * 3  # numbers of a Gaussian
    pixels = cameras.height * cameras.width
    steps = {
        name: float((lengths / step).ceil().mean())
        for name, step in (("rasterize", FORWARD_STEP), ("rasterize_backward", BACKWARD_STEP))
    }
    return RenderingWork(
        programs={
            "project": math.ceil(num / BLOCK),
            "list_tiles": math.ceil(visible / BLOCK),  # others end at once
            "list_entries": math.ceil(pairs / ENTRY_BLOCK),
            "rasterize": tiles,
            "rasterize_backward": tiles,
            "sum_pairs": math.ceil(num / SUM_BLOCK),
            "project_backward": math.ceil(num / BACKWARD_BLOCK),
        },
        rounds={
            "project": (1.0,),
            "list_tiles": (1.0, rows, rows * columns, 0.0),
            "list_entries": (1.0,),
            "rasterize": (1.0, steps["rasterize"]),
            "rasterize_backward": (1.0, steps["rasterize_backward"], 0.0),
            "sum_pairs": (1.0, math.ceil(counts / PAIRS.value)),
            "project_backward": (1.0, 1.0),
        },
        bytes={
            "project": NUMBER * num * (fields + SPLAT.value + 1),
            "list_tiles": NUMBER * (visible * SPLAT.value + 4 * num) + 6 * pairs,
            "list_entries": NUMBER * pairs * 5,
            "rasterize": NUMBER * (visible * SPLAT.value + pairs + 7 * pixels),
            "rasterize_backward": NUMBER
            * (visible * SPLAT.value + pairs * GRADIENT.value + 7 * pixels),
            "sum_pairs": NUMBER * (num * 2 + (pairs + visible) * GRADIENT.value),
            "project_backward": NUMBER * num * (2 * fields + 1 + GRADIENT.value),
        },
        pairs=pairs,
    )


def estimate_launches(
    card: Card, kernel: str, usages: Sequence[Usage], work: RenderingWork
) -> tuple[float, str]:
    """Return the seconds of a kernel's launches, each of which does all work, and the bound."""
    parts = [
        estimate(
            card,
            usage.instructions,
            work.rounds[kernel],
            work.programs[kernel] * usage.warps,
            work.bytes[kernel],
        )
        for usage in usages
    ]
    return sum(seconds for seconds, _ in parts), parts[0][1]


def estimate(
    card: Card,
    instructions: Sequence[Counter[str]],
    rounds: Sequence[float],
    warps: int,
    traffic: float,
) -> tuple[float, str]:
    """Return a kernel's seconds on a card and the resource that bounds it.

    Args:
        instructions: those of a warp, by class, outside of loops and within each.
        rounds: how often each of them is executed; loops beyond the last are not.
        warps: warps of all programs.
        traffic: bytes read and written.
    """
    executed: Counter[str] = Counter()
    for counts, times in zip(instructions, rounds, strict=False):
        for kind, count in counts.items():
            executed[kind] += count * times
    rates = UNITS | {"float64": card.float64}
    clocks = {kind: executed[kind] / rate for kind, rate in rates.items()}
    clocks["issue"] = sum(executed.values()) / ISSUED
    seconds = {
        kind: warps * count / card.multiprocessors / card.clock for kind, count in clocks.items()
    }
    seconds["bytes"] = traffic / card.bandwidth
    bound = max(seconds, key=seconds.__getitem__)
    return seconds[bound], bound


def _mean_of_largest(values: torch.Tensor, block: int) -> float:
    padded = torch.nn.functional.pad(values, (0, -len(values) % block))
    return float(padded.unflatten(0, (-1, block)).amax(1).double().mean())
