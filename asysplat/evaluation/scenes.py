"""Measure all scenes of all test sets, going on where an earlier process was."""

from collections.abc import Mapping
from pathlib import Path

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from torch.utils.data import Dataset

from asysplat.evaluation.figures import comparison_figure
from asysplat.evaluation.post_optimization import PostOptimization, Predict, SceneResult
from asysplat.evaluation.scene_results import load_result, save_result, scene_rows
from asysplat.files import atomic_write
from asysplat.rendering import Rendering


def measure_scenes(
    tests: Mapping[str, Dataset],
    predict: Predict,
    measure: PostOptimization,
    device: torch.device,
    folder: Path,
    kept: Path,
    skipped: Mapping[str, float],
) -> dict[str, list[SceneResult]]:
    """Measure every scene that has no result yet, under a progress bar, and draw the first.

    Args:
        tests: by test set, that of the data itself first, its scenes: their name, `scene`, and
            `inputs` and `targets`.
        predict, measure: see `PostOptimization`.
        device: where to work.
        folder: for figures/evaluation-post<steps>.png: the first scene at the first and the last
            of the steps.
        kept: the folder that has the results of scenes, and to which more are added.
        skipped: the shares that the last prediction left out, see `Network`.
    """
    kept.mkdir(parents=True, exist_ok=True)
    (folder / "figures").mkdir(exist_ok=True)
    drawn = {step: folder / "figures" / f"evaluation-post{step}.png" for step in measure.steps}
    main, last = next(iter(tests)), measure.steps[-1]
    columns = (TextColumn("{task.description:8}"), BarColumn(bar_width=20), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn()) as bars:
        scenes = bars.add_task("scenes", total=sum(map(len, tests.values())))
        steps = bars.add_task("steps", total=last)

        def measured(name: str, index: int) -> SceneResult:
            sample = tests[name][index]
            inputs, targets = (sample[views].to(device) for views in ("inputs", "targets"))

            def watch(step: int, rendering: Rendering | None) -> None:
                bars.update(steps, completed=step)
                if (name, index) == (main, 0) and step in (measure.steps[0], last):
                    with atomic_write(drawn[step]) as partial:
                        comparison_figure(inputs, targets, rendering).savefig(partial, dpi=100)

            result = measure(sample["scene"], predict, inputs, targets, watch)
            result.early_exit.update(skipped)
            bars.console.print(_told(name, result), soft_wrap=True, highlight=False)
            return result

        found: dict[str, list[SceneResult]] = {}
        for name, samples in tests.items():
            found[name] = []
            for index in range(len(samples)):
                path = kept / f"{name}-{index}.json"
                result = load_result(path)
                if result is None:
                    result = measured(name, index)
                    save_result(path, result)
                found[name].append(result)
                bars.advance(scenes)
    return found


def _told(name: str, result: SceneResult) -> str:
    rows = [row for row in scene_rows({name: [result]}) if row["source"] in result.costs]
    steps = ", ".join(f"{row['source'].removeprefix('post')}: {row['psnr']:.2f}" for row in rows)
    return f"{name} {result.scene}, PSNR after steps of post-optimization: {steps}"
