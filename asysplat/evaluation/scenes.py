"""Measure all scenes of all test sets; an interrupted evaluation resumes with the next scene."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import torch
from rich import progress
from torch.utils.data import Dataset

from asysplat.data.datamodule import Sample
from asysplat.errors import InputError
from asysplat.evaluation.figures import comparison_figure
from asysplat.evaluation.measured_cost import mean_but_longest
from asysplat.evaluation.metrics import ImageRow, average
from asysplat.evaluation.post_optimization import PostOptimization, Predict, SceneResult
from asysplat.files import atomic_write, make_folder, read_json
from asysplat.rendering import Rendering
from asysplat.terminal import make_console

Scenes = Mapping[str, Sequence[SceneResult]]  # by test set, the data set's own first


def measure_scenes(
    tests: Mapping[str, Dataset],
    predictor: Callable[[Sample], Predict],
    measure: PostOptimization,
    device: torch.device,
    folder: Path,
    scene_folder: Path,
    costs: Mapping[str, float],
) -> dict[str, list[SceneResult]]:
    """Measure every scene that has no result in `scene_folder` yet, with a progress bar.

    Args:
        tests: test set -> its scenes, the data set's own set first.
        predictor: returns the `predict` of a scene, whose costs are measured.
        folder: for figures/evaluation-post<steps>.png, which show the first scene at the first and
            the last of the steps.
        costs: what the last prediction cost besides seconds and memory.
    """
    make_folder(scene_folder, "paths.logs")
    make_folder(folder / "figures", "paths.logs")
    main, last = next(iter(tests)), measure.steps[-1]
    columns = [progress.TextColumn("{task.description:8}"), progress.BarColumn(bar_width=20)]
    columns += [progress.MofNCompleteColumn(), progress.TimeElapsedColumn()]
    columns += [progress.TimeRemainingColumn()]
    with progress.Progress(*columns, console=make_console()) as bars:
        scenes = bars.add_task("scenes", total=sum(map(len, tests.values())))
        steps = bars.add_task("steps", total=last, visible=last > 0)

        def measure_scene(name: str, index: int) -> SceneResult:
            sample = tests[name][index]
            inputs, targets = (sample[views].to(device) for views in ("inputs", "targets"))

            def show(step: int, rendering: Rendering | None) -> None:
                bars.update(steps, completed=step)
                if (name, index) == (main, 0) and step in (measure.steps[0], last):
                    path = folder / "figures" / f"evaluation-post{step}.png"
                    with atomic_write(path) as partial:
                        comparison_figure(inputs, targets, rendering).savefig(partial, dpi=100)

            result = measure(sample["scene"], predictor(sample), inputs, targets, show)
            result.costs.get("post0", {}).update(costs)
            psnrs = [
                f"{_means(result.rows, 'targets', method, 'images')['psnr']:.2f} dB"
                + f" after {method[4:]} steps" * (method != "post0")
                for method in result.costs
            ]
            message = f"{name} {result.scene}: PSNR {', '.join(psnrs)}"
            bars.console.print(message, soft_wrap=True, highlight=False)
            return result

        results: dict[str, list[SceneResult]] = {name: [] for name in tests}
        stored = 0
        for name, samples in tests.items():
            for index in range(len(samples)):
                path = scene_folder / f"{name}-{index}.json"
                if path.exists():
                    result = read_result(path)
                    stored += 1
                else:
                    result = measure_scene(name, index)
                    save_result(path, result)
                results[name].append(result)
                bars.advance(scenes)
        if stored:
            message = f"measured before, as {scene_folder} has them: {stored} scenes"
            bars.console.print(message, soft_wrap=True, highlight=False)
    return results


def read_result(path: Path) -> SceneResult:
    """Read what `save_result` wrote."""
    try:
        return SceneResult(**read_json(path))
    except TypeError as error:
        raise InputError(f"{path} is not the result of a scene: remove it.") from error


def save_result(path: Path, result: SceneResult) -> None:
    """Write the result of a scene atomically."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(asdict(result)))


def image_rows(scenes: Scenes) -> list[ImageRow]:
    return [
        {"set": test_set, "scene": result.scene, **row}
        for test_set, results in scenes.items()
        for result in results
        for row in result.rows
    ]


def set_results(scenes: Scenes, over: Literal["images", "scenes"]) -> dict[str, float]:
    """Average over each test set; `over`: see `average`.

    As test/<set>/post<steps>/<metric>, of the input views inputs/<set>/post<steps>/psnr,
    baseline/<set>/<baseline>/<metric>, cost/gaussians, cost/post<steps>/seconds, see
    `mean_but_longest`, /gb, the largest, and /steps of refinements, the mean, and of further sets
    under cost/<set>/.
    """
    averages: dict[str, float] = {}
    main = next(iter(scenes))
    for test_set, results in scenes.items():
        rows = image_rows({test_set: results})
        prefix = "cost" if test_set == main else f"cost/{test_set}"
        averages[f"{prefix}/gaussians"] = sum(r.gaussians for r in results) / len(results)
        for method in dict.fromkeys(row["method"] for row in rows):
            tested = "test" if method in results[0].costs else "baseline"
            for kind, images in ((tested, "targets"), ("inputs", "inputs")):
                for name, value in _means(rows, images, method, over).items():
                    averages[f"{kind}/{test_set}/{method}/{name}"] = value
        for method in results[0].costs:
            rows = [result.costs[method] for result in results]
            averages[f"{prefix}/{method}/seconds"] = mean_but_longest([r["seconds"] for r in rows])
            if all("gb" in row for row in rows):
                averages[f"{prefix}/{method}/gb"] = max(row["gb"] for row in rows)
            if all("steps" in row for row in rows):
                steps = sum(row["steps"] for row in rows) / len(rows)
                averages[f"{prefix}/{method}/steps"] = steps
    return averages


def _means(
    rows: Sequence[ImageRow], images: str, method: str, over: Literal["images", "scenes"]
) -> dict[str, float]:
    return average([r for r in rows if (r["images"], r["method"]) == (images, method)], over)
