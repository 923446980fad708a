"""What a run leaves: metrics.json, and a table on the terminal."""

import json
import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from asysplat.evaluation.metrics import PROTOCOL

METRICS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS", "absrel": "AbsRel"}
METRICS["delta1"] = "delta<1.25"
SOURCES = {
    "trained": "test/{}",
    "nearest view, copied": "baseline/{}/nearest_view",
    "mean colour": "baseline/{}/mean_colour",
}


def write_json(path: Path, results: dict[str, float | int | str]) -> None:
    """Flat and sorted, NaN as null, each metric's protocol beside it; complete or not there."""
    finite = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in results.items()
    }
    finite |= {f"protocol/{name}": text for name, text in PROTOCOL.items()}
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(finite, indent=2, sort_keys=True) + "\n")
    partial.replace(path)


def test_sets(results: dict[str, float | int | str]) -> list[str]:
    """The test sets that were measured, in order."""
    keys = (key.split("/") for key in results)
    return [key[1] for key in keys if key[0] == "test" and key[2] == "psnr"]


def quality_table(results: dict[str, float | int], data: str) -> Table:
    """Every metric of a test set, a row each source of images."""
    shown = [name for name in METRICS if f"test/{data}/{name}" in results]
    table = Table("", *(METRICS[name] for name in shown), title=f"test scenes: {data}")
    for label, prefix in SOURCES.items():
        values = [results.get(f"{prefix.format(data)}/{name}") for name in shown]
        table.add_row(label, *("" if v is None else f"{v:.3f}" for v in values))
    return table


def psnr_table(results: dict[str, float | int], names: list[str]) -> Table:
    """A row a test set, PSNR of each source of images."""
    table = Table("", *SOURCES, title="other test sets, PSNR (dB)")
    for name in names:
        values = [results[f"{prefix.format(name)}/psnr"] for prefix in SOURCES.values()]
        table.add_row(name, *(f"{value:.3f}" for value in values))
    return table


def print_summary(results: dict[str, float | int | str], data: str, folder: Path) -> None:
    """The test beside what one gets for nothing, the costs, the pictures; the folder last.

    Args:
        results: as metrics.json has them.
        data: the test set to show in full; of others PSNR alone is shown.
        folder: of the run.
    """
    console = Console()
    measured = test_sets(results)
    if data in measured:
        console.print(quality_table(results, data))
    others = [name for name in measured if name != data]
    if others:
        console.print(psnr_table(results, others))
    costs = []
    if "cost/parameters" in results:
        costs += [
            f"{results['cost/parameters'] / 1e6:.2f}M parameters",
            f"{results['cost/geometry_share']:.1%} of them in the geometry branch",
            f"{results['cost/gaussians']:.0f} Gaussians a scene",
        ]
    if "cost/seconds_per_step" in results:
        step, rendering = results["cost/seconds_per_step"], results["cost/render_seconds"]
        costs.append(f"{step:.2f} s a step, {rendering / step:.1%} of it for rendering")
    if "cost/peak_gb" in results:
        per_token = results["cost/peak_bytes_per_token"] / 1e3
        costs.append(f"{results['cost/peak_gb']:.2f} GB at most, {per_token:.0f} kB a token")
    if costs:
        console.print(", ".join(costs), soft_wrap=True)
    for picture in sorted((folder / "pictures").glob("test-*.png")):
        console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"run: {folder}", soft_wrap=True)
