"""The whole measurement, as plain numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from asysplat.benchmark.choices import check_repeats
from asysplat.benchmark.render.backends import Backend, find_backends
from asysplat.benchmark.render.cases import Case, Scene, describe, find_cases
from asysplat.benchmark.render.run import (
    errors,
    flips,
    peak_gb,
    prepare,
    run,
    truth,
)
from asysplat.benchmark.render.stages import row_seconds, stage_seconds
from asysplat.benchmark.timing import summary
from asysplat.rendering import Skips

RASTER_STAGES = {"forward": "rasterize", "backward": "rasterize_backward"}
Result = dict[str, Any]
Lists = dict[str, list[float]]


@dataclass
class _Row:
    """A backend, perhaps with one skip switched off, and what was measured of it."""

    backend: Backend
    without: str | None
    result: Result = field(default_factory=dict)
    seconds: Lists = field(default_factory=dict)  # forward, backward
    stages: Lists = field(default_factory=dict)
    hot_rows: Lists = field(default_factory=dict)

    @property
    def skips(self) -> Skips:
        return Skips().without(self.without) if self.without else Skips()


def measure(options: DictConfig, console: Console) -> Result:
    """Time every backend on the scenes `options.scenes`, `options.repeats` times.

    Returns:
        "rows": one for each scene, backend and skip that is off, times in seconds.

    Raises:
        InputError: an unknown scene; repeats below 1.
    """
    cases = find_cases(options.scenes)
    check_repeats(options.repeats)
    results: list[Result] = []
    with Progress(console=console) as progress:
        for name, case in cases.items():
            results += _measure_scene(name, case, options.repeats, progress)
    return {"rows": results}


def _measure_scene(name: str, case: Case, repeats: int, progress: Progress) -> list[Result]:
    rows = [_Row(backend, off) for backend in find_backends() for off in (None, *backend.skips)]
    task = progress.add_task(f"scene {name}", total=len(rows) * (2 + repeats))
    scene = case.make()
    small = case.twin() if case.twin else scene
    devices = {row.backend.device for row in rows}
    inputs = {device: prepare(scene, device) for device in devices}
    ignored = _flips_of_any([row for row in rows if row.without is None], small)
    exact = {c: truth(small, c, ignored) for c in {row.backend.convention for row in rows}}
    small_inputs = {device: prepare(small, device, ignored) for device in devices}
    for row in rows:  # two passes warm it up
        row.result |= {"scene": name, "backend": row.backend.name, "without": row.without}
        row.result |= {**describe(scene), "threads": torch.get_num_threads()}
        once = run(row.backend, row.skips, small_inputs[row.backend.device])
        found = errors(once, exact[row.backend.convention], ignored)
        row.result["error"] = {"measured_on": describe(small), **found}
        progress.advance(task)
        row.result["peak_gb"] = peak_gb(row.backend, row.skips, inputs[row.backend.device])
        progress.advance(task)
    row_seconds()  # compiles
    # Everything once a round: whatever else the machine does meets all of it alike.
    for _ in range(repeats):
        for row in rows:
            if row.backend.name == "cpu":
                _append(row.hot_rows, row_seconds())
            with stage_seconds() as stages:
                once = run(row.backend, row.skips, inputs[row.backend.device])
            _append(row.seconds, {"forward": once.forward, "backward": once.backward})
            _append(row.stages, stages)
            row.result["stats"] = once.stats
            progress.advance(task)
    for row in rows:
        row.result |= _summaries(row.seconds)
        row.result["faster_than_reference"] = {
            direction: rows[0].result[direction]["median"] / row.result[direction]["median"]
            for direction in RASTER_STAGES
        }
        if row.backend.name == "cpu":
            row.result["stages"] = _summaries(row.stages)
            row.result["raster"] = _raster(row.result, _summaries(row.hot_rows))
    return [row.result for row in rows]


def _flips_of_any(rows: Sequence[_Row], scene: Scene) -> Tensor:
    """[V, H, W] where any backend flips: there it is not rounding that is compared."""
    found = [
        flips(
            run(row.backend, row.skips, prepare(scene, row.backend.device)),
            truth(scene, row.backend.convention),
        )
        for row in rows
    ]
    return torch.stack(found).any(0)


def _append(lists: Lists, values: Mapping[str, float]) -> None:
    for key, value in values.items():
        lists.setdefault(key, []).append(value)


def _summaries(lists: Mapping[str, Sequence[float]]) -> dict[str, dict[str, float]]:
    return {key: summary(values) for key, values in lists.items()}


def _raster(result: Result, hot_rows: Result) -> Result:
    """How near the raster stages come to their floor, the rows that were evaluated times the cost
    of a hot one over the threads, and the whole calls to the raster stages."""
    compared = {}
    for direction, stage in RASTER_STAGES.items():
        hot_row = hot_rows[direction]["median"]
        floor = result["stats"]["rows"] * hot_row / result["threads"]
        raster = result["stages"][stage]["median"]
        compared[direction] = {
            "hot_row": hot_row,
            "floor": floor,
            "over_floor": raster / floor,
            "whole_over_raster": result[direction]["median"] / raster,
        }
    return compared
