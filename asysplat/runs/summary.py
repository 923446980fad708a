"""Write the results of a run or an evaluation to a file and print them as tables."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from asysplat.evaluation.measured_cost import SECONDS
from asysplat.evaluation.metrics import BASELINES, DEPTH_BASELINES, METRICS
from asysplat.files import atomic_write
from asysplat.terminal import make_console, print_table

TESTED = "tested/"  # group of the options that the scenes of another system were tested with
Results = dict[str, Any]  # numbers and texts, flat, as in metrics.json

TITLES = {name: title for name, (title, _) in (BASELINES | DEPTH_BASELINES).items()}
# Title of a row: prefix of its keys, with a place for the test set.
BASELINE_ROWS = {title: f"baseline/{{}}/{name}" for name, title in TITLES.items()}
ROWS = {"trained": "test/{}"} | BASELINE_ROWS
# The same of a reconstruction, which has one set of photographs
RECONSTRUCTION_ROWS = {
    "held out": "held_out",
    "pixels inputs see": "held_out/seen",
    "gain, offset fitted": "held_out/fitted",
    "inputs": "inputs",
}
RECONSTRUCTION_ROWS |= {title: f"baseline/{name}" for name, title in TITLES.items()}


def write_json(path: Path, results: Results) -> None:
    """Write results atomically: sorted, NaN as null, with the protocol of the seconds."""
    finite = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in results.items()
    }
    finite["protocol/seconds"] = SECONDS
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(finite, indent=2, sort_keys=True) + "\n")


def metric_cells(results: Results, prefix: str, metrics: Iterable[str] = METRICS) -> list[str]:
    """Format results["<prefix>/<metric>"] for a row of a table; empty if not measured."""
    return _cells(results.get(f"{prefix}/{metric}") for metric in metrics)


def metric_rows(
    results: Results, prefixes: Mapping[str, str], metrics: Sequence[str]
) -> list[list[str]]:
    """Make a row of a table, title and `metric_cells`, for each title: prefix with a number."""
    rows = [[title, *metric_cells(results, key, metrics)] for title, key in prefixes.items()]
    return [row for row in rows if any(row[1:])]


def _cells(values: Iterable[float | None], digits: int = 3) -> list[str]:
    return ["" if value is None else f"{value:.{digits}f}" for value in values]


def missing_metrics(results: Results) -> list[str]:
    """Return a sentence for each metric that could not be measured, whose column is empty."""
    names = [name for name in METRICS if f"missing/{name}" in results]
    return [f"{METRICS[name]}: {results[f'missing/{name}']}." for name in names]


def print_missing(results: Results) -> None:
    """Print the sentences of `missing_metrics`, each in a line."""
    for sentence in missing_metrics(results):
        print(sentence)


def describe_costs(results: Results) -> str:
    """Describe the measured costs in a line; empty if none were measured."""
    costs = []
    if "cost/parameters" in results:
        costs += [
            f"{results['cost/parameters'] / 1e6:.2f}M parameters",
            f"{results['cost/geometry_ratio']:.1%} of them in the geometry branch",
            f"{results['cost/gaussians']:.0f} Gaussians a scene",
        ]
    if "cost/seconds_per_step" in results:
        costs.append(f"{results['cost/seconds_per_step']:.2f} s a step")
    if "cost/peak_gb" in results:
        costs.append(f"{results['cost/peak_gb']:.2f} GB at most")
    return ", ".join(costs)


def print_summary(results: Results, data: str, folder: Path) -> None:
    """Print the results of a test set, of each stage, and the PSNR of others; costs; figures."""
    keys = [key.split("/") for key in results]
    test_sets = [key[1] for key in keys if key[0] == "test" and key[2] == "psnr"]
    console = make_console()
    if data in test_sets:
        shown = (f"test/{data}", "missing")
        metrics = [name for name in METRICS if any(f"{key}/{name}" in results for key in shown)]
        ending = f"/test/{data}/psnr"
        stages = [key.removesuffix(ending) for key in results if key.endswith(ending)]
        methods = {f"after {stage}": f"{stage}/test/{data}" for stage in stages}
        methods |= {title: prefix.format(data) for title, prefix in ROWS.items()}
        rows = metric_rows(results, methods, metrics)
        title = f"test scenes: {data}, metrics: {results['protocol/name']}"
        print_table(console, ["", *(METRICS[name] for name in metrics)], rows, title)
    if other_sets := [name for name in test_sets if name != data]:
        titles = ("trained", *(title for title, _ in BASELINES.values()))
        rows = [
            [name, *_cells(results[f"{ROWS[title].format(name)}/psnr"] for title in titles)]
            for name in other_sets
        ]
        print_table(console, ["", *titles], rows, "other test sets, PSNR (dB)")
    print_missing(results)
    if costs := describe_costs(results):
        print(costs)
    _print_figures(folder, "test")
    print(f"run: {folder}")


def print_evaluation(results: Results, sets: Sequence[str], folder: Path) -> None:
    """Print a table for each test set, the data set's own first, the figures and the folder."""
    for name in sets:
        costs = "cost" if name == sets[0] else f"cost/{name}"
        keys = [key.split("/") for key in results if key.startswith(f"test/{name}/post")]
        steps = sorted({int(key[2].removeprefix("post")) for key in keys})
        shown = {key[-1] for key in keys} | {m for m in METRICS if f"missing/{m}" in results}
        metrics = [metric for metric in METRICS if metric in shown]
        title = f"test scenes: {name}, metrics: {results['protocol/name']}"
        if f"{costs}/gaussians" in results:  # none of images
            title += f", {results[f'{costs}/gaussians']:,.0f} Gaussians a scene"
        titles = ("steps", "seconds", "GB", "inputs (dB)", *(METRICS[m] for m in metrics))
        methods = {str(step): (f"test/{name}/post{step}", f"post{step}") for step in steps}
        methods |= {label: (prefix.format(name), "") for label, prefix in BASELINE_ROWS.items()}
        rows = []
        for label, (prefix, method) in methods.items():
            spent = [results.get(f"{costs}/{method}/{unit}") for unit in ("seconds", "gb")]
            inputs = metric_cells(results, f"inputs/{name}/{method}", ["psnr"])
            cells = metric_cells(results, prefix, metrics)
            if any(cells):
                rows.append([label, *_cells(spent, digits=2), *inputs, *cells])
        print_table(make_console(), titles, rows, title)
    print_missing(results)
    _print_figures(folder, "evaluation")
    print(f"evaluation: {folder}")


def _print_figures(folder: Path, kind: str) -> None:
    for path in sorted((folder / "figures").glob(f"{kind}-*.png")):
        print(f"figure: {path}")
