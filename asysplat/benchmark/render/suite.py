"""Every backend of the renderer, and every skip switched off: seconds, memory, error."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat.benchmark.compare import ERROR, TIME, Watched
from asysplat.benchmark.plot import time_against_error
from asysplat.benchmark.render.floor import RASTER, compare_with_floor, row_seconds
from asysplat.benchmark.render.run import (
    Backend,
    Outputs,
    errors,
    find_backends,
    flips,
    prepare,
    run,
    truth,
)
from asysplat.benchmark.scenes import SCENES, SMALLER, Scene, describe, find_scenes
from asysplat.benchmark.table import error, limited, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, ratios, rise_gb, time_in_rounds
from asysplat.rendering import Culling

WATCHED = Watched(
    names=("scene", "backend", "without"),
    alike=("gaussians", "views", "height", "width", "error.measured_on"),
    kinds={
        "forward": TIME,
        "backward": TIME,
        "error.image_p99": ERROR,
        "error.image_max": ERROR,
        "error.gradients": ERROR,
    },
)
# What is asked of the cpu backend with all its culling.
MOST_OVER_FLOOR = 2.5
MOST_WHOLE_OVER_RASTER = 2.0


def measure(options: DictConfig, console: Console) -> Result:
    """Time every backend on the scenes `options.scenes`, `options.repeats` times.

    Returns:
        "rows": one for each scene, backend and skip that is off, times in seconds.

    Raises:
        InputError: an unknown scene.
    """
    results: list[Result] = []
    for name in track(find_scenes(options.scenes), "scenes", console=console):
        results += _measure_scene(name, options.repeats)
    return {"rows": results}


def _measure_scene(name: str, repeats: int) -> list[Result]:
    backends = find_backends()
    scene = SCENES[name]()
    small = SMALLER[name]() if name in SMALLER else scene
    ignored = _flips_of_any(backends, small)
    rows = []
    for backend in backends:
        exact = truth(small, backend.convention, ignored)
        inputs = prepare(scene, backend.device)
        small_inputs = prepare(small, backend.device, ignored)
        for off in (None, *backend.culling):
            culling = Culling().without(off) if off else Culling()
            wrong = errors(run(backend, culling, small_inputs), exact, ignored)
            run_whole = partial(run, backend, culling, inputs)
            found = {
                "scene": name,
                "backend": backend.name,
                "without": off,
                **describe(scene),
                "threads": torch.get_num_threads(),
                "error": {"measured_on": describe(small), **wrong},
                "peak_gb": rise_gb(run_whole, torch.device(backend.device)),
            }
            rows.append(Measurement(partial(_seconds, run_whole, found), found))
    (cpu,) = [backend for backend in backends if backend.name == "cpu"]
    hot_rows = Measurement(lambda: row_seconds(cpu))
    time_in_rounds([*rows, hot_rows], repeats)
    for row in rows:
        row.found |= {direction: row.summary(direction) for direction in RASTER}
        row.found["faster_than_reference"] = ratios(rows[0].found, row.found, RASTER)
        if row.found["backend"] == "cpu":
            kernels = [name for name in row.seconds if name not in RASTER]
            # The key is that of results which are published.
            row.found["stages"] = {name: row.summary(name) for name in kernels}
            row.found["raster"] = compare_with_floor(row, hot_rows)
    return [row.found for row in rows]


def _flips_of_any(backends: Sequence[Backend], scene: Scene) -> Tensor:
    """Find the pixels [V, H, W] where any backend flips: there more than rounding differs."""
    pairs = [
        (run(b, Culling(), prepare(scene, b.device)), truth(scene, b.convention)) for b in backends
    ]
    return torch.stack([flips(found, exact) for found, exact in pairs]).any(0)


def _seconds(run_whole: Callable[[], Outputs], found: Result) -> dict[str, float]:
    """Time both passes and the kernels in them; the counts go to `found`."""
    outputs = run_whole()
    found["stats"] = outputs.stats
    return outputs.seconds | outputs.kernels


def tables(results: Result) -> list[Table]:
    """Show all rows; what the cpu backend's time goes into; how near that is to the least."""
    rows = results["rows"]
    ours = [row for row in rows if row["backend"] == "cpu" and row["without"] is None]
    notes = (
        f"{measured_on(results)}; *: errors of a smaller scene of the same make;\n"
        "errors outside the pixels where some backend's rounding decides otherwise at a cut-off"
    )
    columns = {
        "scene": text("{scene}"),
        "backend": lambda row: f"  no {row['without']} skip" if row["without"] else row["backend"],
        "forward\nms": spread("forward"),
        "backward\nms": spread("backward"),
        "memory\nMB": number("peak_gb", "{:.0f}", unit=1e-3),
        "image\np99": error("error.image_p99"),
        "image\nmax": error("error.image_max"),
        "flips\n1e-6": number("error.flipped", "{:.0f}", unit=1e-6),
        "gradients\nworst": error("error.gradients"),
    }
    kernels = ours[0]["stages"] if ours else ()
    passes = {name.replace("_", "\n"): spread(f"stages.{name}") for name in kernels}
    limits = {
        "scene": text("{scene}"),
        "pass": text("{pass}"),
        "rows\nmillions": number("stats.rows", "{:.2f}", unit=1e6),
        "hot row\nns": number("hot_row", "{:.1f}", unit=1e-9),
        "floor\nms": number("floor", "{:.1f}", unit=1e-3),
        "raster\n/ floor": limited("over_floor", MOST_OVER_FLOOR),
        "whole\n/ raster": limited("whole_over_raster", MOST_WHOLE_OVER_RASTER),
        "reference\n/ cpu": number("faster", "{:.1f}"),
    }
    both = [
        row | row["raster"][name] | {"pass": name, "faster": row["faster_than_reference"][name]}
        for row in ours
        for name in RASTER
    ]
    asked = (
        f"asked for: raster / floor at most {MOST_OVER_FLOOR}, whole / raster at most "
        f"{MOST_WHOLE_OVER_RASTER}"
    )
    return [
        make_table("Every backend, and without one of its skips", columns, rows, notes, names=2),
        make_table("Passes of the cpu backend, ms", {"scene": text("{scene}"), **passes}, ours),
        make_table("The cpu backend's limits", limits, both, asked, names=2),
    ]


def plot(results: Result) -> Figure:
    """Plot the forward and the backward pass, of every backend with all its culling."""
    errors = {
        "forward": ("image against float64, 99th percentile", "error.image_p99"),
        "backward": ("worst gradient against float64, relative L2", "error.gradients"),
    }
    rows = [row for row in results["rows"] if row["without"] is None]
    return time_against_error(rows, errors, backend="backend", case="scene")
