"""Measure all scenes of all test sets; an interrupted evaluation resumes with the next scene."""

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
    scene_folder: Path,
    early_exit: Mapping[str, float],
) -> dict[str, list[SceneResult]]:
    """Measure every scene that has no result yet, with a progress bar, and draw the first.

    Args:
        tests: by test set, the data set's own first, its scenes: their name, `scene`, and `inputs`
            and `targets`.
        predict, measure: see `PostOptimization`.
        device: that computes.
        folder: for figures/evaluation-post<steps>.png: the first scene at the first and the last
            of the steps.
        scene_folder: the results of single scenes are read from it and written to it.
        early_exit: the shares that the last prediction left out, see `Network`.
    """
    scene_folder.mkdir(parents=True, exist_ok=True)
    (folder / "figures").mkdir(exist_ok=True)
    main, last = next(iter(tests)), measure.steps[-1]
    columns = (TextColumn("{task.description:8}"), BarColumn(bar_width=20), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn()) as bars:
        scenes = bars.add_task("scenes", total=sum(map(len, tests.values())))
        steps = bars.add_task("steps", total=last)

        def measure_scene(name: str, index: int) -> SceneResult:
            sample = tests[name][index]
            inputs, targets = (sample[views].to(device) for views in ("inputs", "targets"))

            def show(step: int, rendering: Rendering | None) -> None:
                bars.update(steps, completed=step)
                if (name, index) == (main, 0) and step in (measure.steps[0], last):
                    path = folder / "figures" / f"evaluation-post{step}.png"
                    with atomic_write(path) as partial:
                        comparison_figure(inputs, targets, rendering).savefig(partial, dpi=100)

            result = measure(sample["scene"], predict, inputs, targets, show)
            result.early_exit.update(early_exit)
            rows = scene_rows({name: [result]})
            psnrs = {row["source"]: row["psnr"] for row in rows if row["source"] in result.costs}
            psnrs = [f"{source.removeprefix('post')}: {psnr:.2f}" for source, psnr in psnrs.items()]
            sentence = f"{name} {result.scene}, PSNR after steps of post-optimization: "
            bars.console.print(sentence + ", ".join(psnrs), soft_wrap=True, highlight=False)
            return result

        results: dict[str, list[SceneResult]] = {name: [] for name in tests}
        for name, samples in tests.items():
            for index in range(len(samples)):
                path = scene_folder / f"{name}-{index}.json"
                result = load_result(path)
                if result is None:
                    result = measure_scene(name, index)
                    save_result(path, result)
                results[name].append(result)
                bars.advance(scenes)
    return results
