"""Where the cpu backend's time goes, and the least that its raster stages could take."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from unittest import mock

import numpy as np
import torch

from asysplat.benchmark.render.rows import (
    BACKWARD_STATE,
    STATE,
    backward_rows,
    forward_rows,
)
from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.rendering import INRIA
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.splat import RasterSettings
from asysplat.rendering.formulas import WHITEN_TO_LOG2

STAGES = ("project", "start_positions", "place", "rasterize")
STAGES += ("rasterize_backward", "project_backward")
TILES, TIMES = 256, 512  # two million rows: tens of milliseconds
REPEATS = 3  # of which the best counts: what disturbs a loop so hot makes it slower only
DEVIATION = 2.0  # of the splat that is drawn in them, in pixels
OPACITY = 0.01  # so many of it leave every pixel some transmittance
CENTER = (0.3, -7.6)  # to the middle of the first row: the splat is in the middle of the tile


@contextmanager
def stage_seconds() -> Iterator[dict[str, float]]:
    """Seconds that the cpu backend spends in each of STAGES meanwhile."""
    seconds = dict.fromkeys(STAGES, 0.0)

    def timed(kernel: Callable, *args: object) -> list:
        start = time.perf_counter()
        results = run_blocks(kernel, *args)
        seconds[kernel.__name__] += time.perf_counter() - start
        return results

    # By its module's name: as an attribute of the package, `draw` is the function.
    with mock.patch.object(import_module("asysplat.rendering.cpu.draw"), "run_blocks", timed):
        yield seconds


def row_seconds() -> dict[str, float]:
    """Seconds of one row in a hot loop, forward and backward, on one of the cores while all of
    torch's threads are busy so."""
    convention = (INRIA.alpha_min, INRIA.alpha_max, INRIA.transmittance_min)
    settings = RasterSettings(*map(np.float32, convention), skip_rows=False, skip_opaque=False)
    kernels = {
        "forward": (forward_rows, STATE),
        "backward": (backward_rows, BACKWARD_STATE),
    }
    splat = middle_splat(OPACITY)
    seconds = {}
    for direction, (kernel, size) in kernels.items():
        walls = []
        for _ in range(REPEATS):
            states = np.ones((TILES, size), np.float32)
            start = time.perf_counter()
            run_blocks(kernel, even_bounds(TILES), splat, CENTER, TIMES, settings, states)
            walls.append(time.perf_counter() - start)
        seconds[direction] = min(walls) * torch.get_num_threads() / (TILES * TIMES * col.TILE)
    return seconds


def middle_splat(opacity: float) -> np.ndarray:
    """A round one in the middle of a tile."""
    splat = np.zeros(col.SPLAT, np.float32)
    splat[[col.A, col.C]] = WHITEN_TO_LOG2 / DEVIATION
    splat[col.LOG_OPACITY] = np.log2(opacity)
    splat[[col.RED, col.GREEN, col.BLUE]] = 0.5
    return splat
