"""Save the results of single scenes and collect them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from asysplat.evaluation.measured_cost import mean_but_longest
from asysplat.evaluation.post_optimization import SceneResult
from asysplat.evaluation.rows import ImageRow, average
from asysplat.files import atomic_write

Scenes = Mapping[str, Sequence[SceneResult]]  # by test set, the data set's own first


def save_result(path: Path, result: SceneResult) -> None:
    """Write the result of a scene atomically."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(asdict(result)))


def load_result(path: Path) -> SceneResult | None:
    """Read the result of a scene; None if there is no such file."""
    return SceneResult(**json.loads(path.read_text())) if path.exists() else None


def image_rows(scenes: Scenes) -> list[ImageRow]:
    """Return the rows of all images."""
    return [
        {"set": test_set, "scene": result.scene, **row}
        for test_set, results in scenes.items()
        for result in results
        for row in result.rows
    ]


def scene_rows(scenes: Scenes) -> list[ImageRow]:
    """Return a row for each scene and source: costs, input PSNR, means over its targets."""
    rows: list[ImageRow] = []
    for test_set, results in scenes.items():
        for result in results:
            for source in dict.fromkeys(row["source"] for row in result.rows):
                means = _means(result.rows, "targets", source, "images")
                inputs = _means(result.rows, "inputs", source, "images")
                row = {"set": test_set, "scene": result.scene, "source": source}
                if source in result.costs:
                    row |= {"gaussians": result.gaussians, **result.costs[source]}
                rows.append(row | {f"inputs/{k}": v for k, v in inputs.items()} | means)
    return rows


def set_results(scenes: Scenes, over: Literal["images", "scenes"]) -> dict[str, float]:
    """Average over each test set; `over`: see `average`.

    Returns:
        test/<set>/post<steps>/<metric>, of the input views inputs/<set>/post<steps>/psnr,
        baseline/<set>/<baseline>/<metric>, and cost/gaussians, cost/post<steps>/seconds (the
        `mean_but_longest`) and /gb (the largest); of further sets under cost/<set>/. With an early
        exit also early_exit/<set>/<what>.
    """
    averages: dict[str, float] = {}
    main = next(iter(scenes))
    for test_set, results in scenes.items():
        rows = image_rows({test_set: results})
        costs = "cost" if test_set == main else f"cost/{test_set}"
        averages[f"{costs}/gaussians"] = sum(r.gaussians for r in results) / len(results)
        for name, share in average([dict(r.early_exit) for r in results], "images").items():
            averages[f"early_exit/{test_set}/{name}"] = share
        for source in dict.fromkeys(row["source"] for row in rows):
            tested = "test" if source in results[0].costs else "baseline"
            for kind, images in ((tested, "targets"), ("inputs", "inputs")):
                for name, value in _means(rows, images, source, over).items():
                    averages[f"{kind}/{test_set}/{source}/{name}"] = value
        for source in results[0].costs:
            every = [result.costs[source] for result in results]
            averages[f"{costs}/{source}/seconds"] = mean_but_longest([c["seconds"] for c in every])
            if all("gb" in each for each in every):
                averages[f"{costs}/{source}/gb"] = max(each["gb"] for each in every)
    return averages


def _means(
    rows: Sequence[ImageRow], images: str, source: str, over: Literal["images", "scenes"]
) -> dict[str, float]:
    return average([r for r in rows if (r["images"], r["source"]) == (images, source)], over)
