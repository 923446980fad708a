"""The results of a run or an evaluation: a file, and tables on the terminal."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from asysplat.evaluation.measured_cost import SECONDS
from asysplat.files import atomic_write

Results = dict[str, float | int | str]  # flat, as in metrics.json

METRICS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS", "absrel": "AbsRel"}
METRICS["delta1"] = "delta<1.25"
BASELINES = {
    "nearest view, copied": "baseline/{}/nearest_view",
    "mean color": "baseline/{}/mean_color",
}
SOURCES = {"trained": "test/{}"} | BASELINES


def write_json(path: Path, results: Results) -> None:
    """Write results sorted, NaN as null, with a sentence on how seconds are measured.

    The file appears complete or not at all.
    """
    finite = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in results.items()
    }
    finite["protocol/seconds"] = SECONDS
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(finite, indent=2, sort_keys=True) + "\n")


def test_sets(results: Results) -> list[str]:
    """List the test sets that were measured, in order."""
    keys = (key.split("/") for key in results)
    return [key[1] for key in keys if key[0] == "test" and key[2] == "psnr"]


def quality_table(results: Results, data: str) -> Table:
    """Make the table of one test set: a column for each metric, a row for each image source.

    The stages of a training before the last have rows of their own, as metrics.json has them.
    """
    shown = [name for name in METRICS if f"test/{data}/{name}" in results]
    title = f"test scenes: {data}, metrics: {results['protocol/name']}"
    table = Table("", *(METRICS[name] for name in shown), title=title)
    ending = f"/test/{data}/psnr"
    earlier = [key.removesuffix(ending) for key in results if key.endswith(ending)]
    sources = {f"after {stage}": f"{stage}/test/{{}}" for stage in earlier} | SOURCES
    for label, prefix in sources.items():
        values = [results.get(f"{prefix.format(data)}/{name}") for name in shown]
        table.add_row(label, *("" if v is None else f"{v:.3f}" for v in values))
    return table


def psnr_table(results: Results, names: list[str]) -> Table:
    """Make the table of several test sets: a row for each, PSNR of each image source."""
    table = Table("", *SOURCES, title="other test sets, PSNR (dB)")
    for name in names:
        values = [results[f"{prefix.format(name)}/psnr"] for prefix in SOURCES.values()]
        table.add_row(name, *(f"{value:.3f}" for value in values))
    return table


def post_optimization_table(results: Results, name: str, costs: str) -> Table:
    """Make the table of one test set after steps of post-optimization, and of its inputs' PSNR.

    Args:
        results: as in evaluation.json.
        name: of the test set.
        costs: the beginning of the keys of its costs.
    """
    keys = [key.split("/") for key in results if key.startswith(f"test/{name}/post")]
    steps = sorted({int(key[2].removeprefix("post")) for key in keys})
    shown = [metric for metric in METRICS if [metric] in [key[3:] for key in keys]]
    title = f"test scenes: {name}, metrics: {results['protocol/name']}, "
    title += f"{results[f'{costs}/gaussians']:,.0f} Gaussians a scene"
    titles = ("seconds", "GB", "inputs (dB)", *(METRICS[metric] for metric in shown))
    table = Table(Column("steps", min_width=12), *titles, title=title)
    rows = {str(step): (f"test/{name}/post{step}", f"post{step}") for step in steps}
    rows |= {label: (prefix.format(name), "") for label, prefix in BASELINES.items()}
    for label, (prefix, source) in rows.items():
        seconds, gb = (results.get(f"{costs}/{source}/{unit}") for unit in ("seconds", "gb"))
        inputs = results.get(f"inputs/{name}/{source}/psnr")
        values = [inputs, *(results.get(f"{prefix}/{metric}") for metric in shown)]
        cells = ["" if each is None else f"{each:.2f}" for each in (seconds, gb)]
        table.add_row(label, *cells, *("" if v is None else f"{v:.3f}" for v in values))
    return table


def cost_sentence(results: Results) -> str:
    """Write the measured costs as a sentence; empty if none were measured."""
    costs = []
    if "cost/parameters" in results:
        costs += [
            f"{results['cost/parameters'] / 1e6:.2f}M parameters",
            f"{results['cost/geometry_share']:.1%} of them in the geometry branch",
            f"{results['cost/gaussians']:.0f} Gaussians a scene",
        ]
    if "cost/seconds_per_step" in results:
        step, rendering = results["cost/seconds_per_step"], results["cost/render_seconds_per_step"]
        costs.append(f"{step:.2f} s a step, {rendering / step:.1%} of it for rendering")
    if "cost/peak_gb" in results:
        per_token = results["cost/peak_bytes_per_token"] / 1e3
        costs.append(f"{results['cost/peak_gb']:.2f} GB at most, {per_token:.0f} kB a token")
    return ", ".join(costs)


def print_summary(results: Results, data: str, folder: Path) -> None:
    """Print the test and its baselines, the costs, the pictures and, last, the run's folder.

    Args:
        results: of a run; what was not measured is left out.
        data: the test set to show in full; for others only PSNR is shown.
        folder: of the run.
    """
    console = Console()
    measured = test_sets(results)
    if data in measured:
        console.print(quality_table(results, data))
    others = [name for name in measured if name != data]
    if others:
        console.print(psnr_table(results, others))
    if costs := cost_sentence(results):
        console.print(costs, soft_wrap=True)
    for picture in sorted((folder / "figures").glob("test-*.png")):
        console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"run: {folder}", soft_wrap=True)


def print_evaluation(results: Results, sets: Sequence[str], folder: Path) -> None:
    """Print what evaluate.py found: a table for each test set, pictures and, last, the folder.

    Args:
        results: as in evaluation.json.
        sets: the test sets, that of the data itself first.
        folder: where the results are.
    """
    console = Console()
    for name in sets:
        costs = "cost" if name == sets[0] else f"cost/{name}"
        console.print(post_optimization_table(results, name, costs))
    for picture in sorted((folder / "figures").glob("evaluation-*.png")):
        console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"evaluation: {folder}", soft_wrap=True)
