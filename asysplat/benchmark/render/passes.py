"""Where the cpu backend's time goes, and the least that its raster passes could take."""

from functools import cache

import torch

from asysplat.benchmark.render.run import Backend, Inputs, Outputs, prepare, run
from asysplat.benchmark.timing import time_calls
from asysplat.ops.cpu.threads import run_blocks
from asysplat.rendering import Skips
from asysplat.scene import Cameras, Gaussians

RASTER = {"forward": "rasterize", "backward": "rasterize_backward"}  # the kernels
REPEATS = 3  # of which the best counts: what disturbs a loop so hot makes it slower only
SIDE = 256  # pixels of the image that is made of hot rows
COUNT = 512  # two million rows: tens of milliseconds
OPACITY = 0.01  # COUNT of it leave every pixel some transmittance


def run_timed(backend: Backend, skips: Skips, inputs: Inputs) -> tuple[Outputs, dict[str, float]]:
    """Run both passes; return also the seconds of each kernel, of the cpu backend."""
    if backend.name != "cpu":
        return run(backend, skips, inputs), {}
    kernels = {run_blocks: lambda frame: frame.f_locals["kernel"].__name__}
    with time_calls(kernels, torch.device("cpu")) as seconds:
        return run(backend, skips, inputs), seconds


def row_seconds(cpu: Backend) -> dict[str, float]:
    """Time a 16-pixel row of a tile in a scene that is nothing but rows, by direction.

    It is the time of a core while all threads are busy so.
    """
    best: dict[str, float] = {}
    for _ in range(REPEATS):
        outputs, seconds = run_timed(cpu, Skips(), hot_scene())
        for direction, kernel in RASTER.items():
            row = seconds[kernel] * torch.get_num_threads() / outputs.stats["rows"]
            best[direction] = min(row, best.get(direction, row))
    return best


@cache
def hot_scene() -> Inputs:
    """Place COUNT faint Gaussians one behind the other, each wider than the image.

    Every row of every tile is evaluated for each: there is nothing to skip.
    """
    gaussians = Gaussians(
        means=torch.tensor([0.0, 0.0, 4.0]).repeat(COUNT, 1),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(COUNT, 1),
        scales=torch.tensor([40.0, 40.0, 0.01]).repeat(COUNT, 1),
        opacities=torch.full((COUNT,), OPACITY),
        sh=torch.full((COUNT, 1, 3), 0.5),
    )
    intrinsics = torch.tensor([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics[None], torch.eye(4)[None], SIDE, SIDE)
    return prepare((gaussians, cameras), "cpu")
