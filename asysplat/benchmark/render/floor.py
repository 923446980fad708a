"""The least that the raster passes of the cpu backend could take."""

from functools import cache

import torch

from asysplat.benchmark.render.run import Backend, Inputs, prepare, run
from asysplat.benchmark.timing import Measurement, Result
from asysplat.rendering import Culling
from asysplat.scene import Cameras, Gaussians

RASTER = {"forward": "rasterize", "backward": "rasterize_backward"}  # the kernels
REPEATS = 3  # of which the best counts: what disturbs a loop so hot makes it slower only
SIDE = 256  # pixels of the image that is made of hot rows
COUNT = 512  # two million rows: tens of milliseconds
OPACITY = 0.01  # COUNT of it leave every pixel some transmittance


def row_seconds(cpu: Backend) -> dict[str, float]:
    """Time a 16-pixel row of a tile in a scene that is nothing but rows, by direction.

    It is the time of a core while all threads are busy so.
    """
    runs = [run(cpu, Culling(), hot_scene()) for _ in range(REPEATS)]
    rows = runs[0].stats["rows"] / torch.get_num_threads()
    return {name: min(r.kernels[kernel] for r in runs) / rows for name, kernel in RASTER.items()}


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


def compare_with_floor(row: Measurement, hot_rows: Measurement) -> Result:
    """Compare the raster passes with their floor, and both passes whole with the raster passes.

    The floor is the rows that were evaluated times the cost of a hot one, over the threads.
    """
    compared = {}
    for direction, kernel in RASTER.items():
        hot_row = hot_rows.summary(direction)["median"]
        floor = row.found["stats"]["rows"] * hot_row / row.found["threads"]
        raster = row.summary(kernel)["median"]
        compared[direction] = {
            "hot_row": hot_row,
            "floor": floor,
            "over_floor": raster / floor,
            "whole_over_raster": row.found[direction]["median"] / raster,
        }
    return compared
