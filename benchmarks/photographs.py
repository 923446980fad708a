"""Quality, seconds and memory over the number of photographs, each number in its own process."""

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import cycle
from pathlib import Path

import matplotlib
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from asysplat import load, predict
from asysplat.data.photographs import Photographs
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.measured_cost import peak_memory_gb
from asysplat.evaluation.protocol import Protocol
from asysplat.rendering import render
from asysplat.scene import Cameras
from benchmarks.compare import DECIBELS, LPIPS_DISTANCE, TrackedMetrics
from benchmarks.pareto import NOISE_OF_SECONDS, find_scenes
from benchmarks.systems import measure_quality
from benchmarks.table import Columns, machine_text, make_table, number_column, text_column
from benchmarks.timing import Result
from paper.style import FAINT, OURS, PAPER, STYLE

TRACKED = TrackedMetrics(
    names=("scene", "views", "asked"),
    must_match=("side",),
    kinds={"psnr": DECIBELS, "lpips": LPIPS_DISTANCE},
)
NOTES = """\
asked: seconds of predict; 0: load("shipped"), a Gaussian for each pixel of each photograph
s: from photographs in memory to Gaussians, without the seconds that compile kernels
GB: largest resident set of a process that does this alone, drawing the held-out views with it"""
MIN_SIDE = 16  # pixels at which the photographs of a scene are counted
PANELS = {"psnr": "PSNR of held-out photographs, dB", "seconds": "seconds", "gb": "GB"}


def measure(options: DictConfig, console: Console) -> Result:
    """Measure each number of photographs of each scene, with each number of seconds.

    Returns:
        "rows": for each of them the seconds, the memory and the metrics of held-out views.
        "not_measured": the reason for what was not measured.
    """
    config = OmegaConf.to_container(options.photographs, resolve=True)
    shared, rows = Path(config["shared"]), []
    scenes, absent = find_scenes(config["scenes"], shared / "data", "photographs.scenes")
    protocol = instantiate(options.metrics)
    spawn = multiprocessing.get_context("spawn")
    for scene, open_scene in scenes.items():
        most = open_scene(MIN_SIDE, max(config["views"]), 1).inputs.num_views
        for views in sorted({min(count, most) for count in config["views"]}):
            for asked in config["seconds"]:
                opening = partial(open_scene, config["side"], views, config["held_out"])
                # In a process of its own, whose largest memory is that of this row.
                with ProcessPoolExecutor(1, spawn) as process:
                    found = process.submit(
                        measure_one, opening, asked, protocol, shared / "weights"
                    ).result()
                row = {"scene": scene, "side": config["side"], "views": views, "asked": asked}
                rows.append(row | found)
                text = "{views} photographs, {asked:g} s asked: {psnr:.2f} dB, {gb:.2f} GB"
                console.print(f"{escape(scene)}: {text.format(**rows[-1])}", highlight=False)
    return {"protocol": protocol.describe(), "not_measured": absent, "rows": rows}


def measure_one(
    open_scene: Callable[[], Photographs], asked: float, protocol: Protocol, weights: Path
) -> Result:
    """Measure a scene in this process, of which nothing else is measured."""
    photographs = open_scene()
    lpips = load_lpips(protocol.lpips_net, weights)
    inputs, held_out = photographs.inputs, photographs.held_out
    few = inputs.select(range(2))
    with torch.no_grad():
        predict(few, 0.1)  # compiles the kernels
        clock = time.perf_counter()
        gaussians = predict(inputs, asked) if asked else load("shipped")(inputs)
        seconds = time.perf_counter() - clock

        def draw(cameras: Cameras) -> Tensor:
            return render(gaussians, cameras, photographs.background, depth=False).image

        quality = measure_quality(protocol, held_out, lpips, draw)
    row = {"seconds": seconds, "gb": peak_memory_gb("cpu"), "noise": NOISE_OF_SECONDS}
    return row | {"gaussians": gaussians.num_gaussians} | quality


def tables(results: Result) -> list[Table]:
    """Show all scenes."""
    absent = "\n".join(f"not measured: {k}, {why}" for k, why in results["not_measured"].items())
    notes = "\n".join(filter(None, (machine_text(results), NOTES, absent)))
    return [make_table("More and more photographs", COLUMNS, results["rows"], notes)]


def plot(results: Result) -> Figure:
    """Plot quality, seconds and memory over the number of photographs, a line for each scene."""
    rows = results["rows"]
    scenes, durations = (dict.fromkeys(row[name] for row in rows) for name in ("scene", "asked"))
    colors = cycle((OURS, PAPER, "#2f8f4e", FAINT))
    scenes = dict(zip(scenes, colors, strict=False))
    styles = dict(zip(durations, cycle(("--", "-", ":")), strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(13.5, 4.2), layout="constrained")
        for axes, (name, title) in zip(figure.subplots(1, 3), PANELS.items(), strict=True):
            for scene, color in scenes.items():
                for asked, style in styles.items():
                    those = [r for r in rows if (r["scene"], r["asked"]) == (scene, asked)]
                    points = [(row["views"], row[name]) for row in those]
                    label = f"{scene}, {asked:g} s of predict" if asked else f"{scene}, the sweep"
                    axes.plot(
                        *zip(*points, strict=True), style, color=color, label=label, marker="o"
                    )
            axes.set(title=title, xlabel="photographs", xscale="log")
            axes.xaxis.set_major_locator(LogLocator(2))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


COLUMNS: Columns = {
    "scene": text_column("{scene}"),
    "photographs": number_column("views", "{:.0f}"),
    "asked": number_column("asked", "{:g}"),
    "s": number_column("seconds", "{:.1f}"),
    "GB": number_column("gb", "{:.2f}"),
    "Gaussians": number_column("gaussians", "{:,.0f}"),
    "PSNR": number_column("psnr", "{:.2f}"),
    "SSIM": number_column("ssim", "{:.3f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
}
