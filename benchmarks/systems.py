"""Quality over seconds: refinements as ours and others schedule them.

Every system gets the same photographs and is measured on the same held-out ones. A refinement is
measured on its way; its clock stands still meanwhile.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean

import matplotlib
import torch
from hydra.utils import instantiate
from lpips import LPIPS
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat.data.photographs import Photographs
from asysplat.errors import InputError
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.metrics import average as average_metrics
from asysplat.evaluation.protocol import Protocol
from asysplat.refinement import (
    DEFAULT,
    PUBLISHED_3DGS,
    SCAFFOLD_GS,
    Refinement,
    RefinementProgress,
    RefinementSettings,
    ScaffoldSettings,
    refine,
    refine_scaffold,
)
from asysplat.refinement.init import initial_gaussians
from asysplat.rendering import render
from asysplat.scene import Cameras, Views
from benchmarks.compare import DECIBELS, LPIPS_DISTANCE, TrackedMetrics
from benchmarks.options import check_names
from benchmarks.pareto import NOISE_OF_SECONDS, find_scenes
from benchmarks.table import Columns, machine_note, make_table, number_column, text_column
from benchmarks.timing import Result
from paper.style import FAINT, OURS, PAPER, STYLE

PUBLISHED_STEPS = 30_000  # of 3DGS and Scaffold-GS
TRACKED = TrackedMetrics(
    names=("scene", "system", "mark"),
    must_match=("photographs", "limit"),
    kinds={"psnr": DECIBELS, "lpips": LPIPS_DISTANCE},
)
NOTES = """\
mark: seconds after which a refinement is measured; s: those it took
start: what the Gaussians are placed by: points of the files where a scene has them
cut: the published 30,000 steps, ended by the time limit; else the schedule takes all the time"""


@dataclass(frozen=True)
class RefinedSystem:
    """A refinement: its start, its settings, and whether its published schedule is cut."""

    start: str | None  # see `initial_gaussians`; None: points, else a plane sweep
    settings: RefinementSettings | ScaffoldSettings
    cut: bool = False


CURVES = {
    "plane sweep, refined": RefinedSystem("plane_sweep", DEFAULT),
    "3DGS": RefinedSystem(None, PUBLISHED_3DGS),
    "3DGS, cut": RefinedSystem(None, PUBLISHED_3DGS, cut=True),
    "Scaffold-GS": RefinedSystem(None, SCAFFOLD_GS),
    "Scaffold-GS, cut": RefinedSystem(None, SCAFFOLD_GS, cut=True),
}
COLORS = {"plane sweep, refined": OURS, "3DGS": PAPER, "Scaffold-GS": "#2f8f4e"}
Draw = Callable[[Cameras], Tensor]  # images of a scene, [V, 3, H, W]
Measure = Callable[[Draw, bool], Result]  # the bool: whether it is the last time


def measure(options: DictConfig, console: Console) -> Result:
    """Measure every system of `options.systems` on every scene.

    Returns:
        "rows": one for each scene, system and mark: seconds, steps and Gaussians, the metrics of
        the held-out views. "not_measured": the reason for what was not measured.
    """
    config = OmegaConf.to_container(options.systems, resolve=True)
    marks, shared = config["marks"], Path(config["shared"])
    increasing = all(a < b for a, b in zip([0, *marks], marks, strict=False))
    if not marks or not increasing:
        raise InputError(f"systems.marks={marks}: give increasing seconds above 0.")
    names = list(CURVES) if config["names"] == "all" else config["names"]
    check_names("systems.names", names, [*CURVES, "all"])
    scenes, absent = find_scenes(config["scenes"], shared / "data", "systems.scenes")
    protocol = instantiate(options.metrics)
    lpips = load_lpips(protocol.lpips_net, shared / "weights")
    if lpips is None:
        absent["LPIPS"] = f"{shared / 'weights'} has no weights of its backbone"
    rows: list[Result] = []
    for scene_name, open_scene in scenes.items():
        photographs = open_scene(**config["photographs"])
        quality = partial(measure_quality, protocol, photographs.held_out, lpips)

        where = {"scene": scene_name, "photographs": config["photographs"], "limit": marks[-1]}
        for name in track(names, escape(scene_name), console=console, transient=True):
            found = measure_refinement(photographs, CURVES[name], marks, quality)
            rows += [where | {"system": name} | row for row in found]
        console.print(f"{scene_name}: {len(names)} systems", highlight=False)
    return {"protocol": protocol.describe(), "not_measured": absent, "rows": rows}


def measure_quality(
    protocol: Protocol, targets: Views, lpips: LPIPS | None, draw: Draw, last: bool = True
) -> dict[str, float]:
    """Compute the means of the metrics over some views, which are drawn one by one."""
    rows = []
    for view in range(targets.num_views):
        target = targets.select([view])
        rows += protocol.measure_views(draw(target.cameras), None, target, lpips)
    return average_metrics(rows, "images")


def measure_refinement(
    photographs: Photographs, curve: RefinedSystem, marks: Sequence[float], quality: Measure
) -> list[Result]:
    """Measure a refinement after each mark, in seconds."""
    settings, inputs = curve.settings, photographs.inputs
    start = curve.start or ("plane_sweep" if photographs.points is None else "points")
    clock = time.perf_counter()
    gaussians = initial_gaussians(
        start, photographs.inputs, settings.initial_limit, photographs.points
    )
    before = time.perf_counter() - clock
    background, rows, due = photographs.background, [], list(marks)

    def watch(progress: RefinementProgress, refinement) -> bool:
        ended = progress.fraction == 1  # maybe before the last mark
        reached = [mark for mark in due if ended or progress.seconds >= mark]
        if reached:
            if isinstance(refinement, Refinement):
                draw = partial(render, refinement.gaussians)
            else:
                draw = refinement.scene.render
            row = {"seconds": before + progress.seconds, "steps": progress.step, "start": start}
            row |= {"gaussians": progress.gaussians, "noise": NOISE_OF_SECONDS}
            last = len(reached) == len(due)
            with torch.no_grad():
                row |= quality(lambda cameras: draw(cameras, background, depth=False).image, last)
            rows.extend({"mark": mark} | row for mark in reached)
            del due[: len(reached)]
        return not due

    function = refine_scaffold if isinstance(settings, ScaffoldSettings) else refine
    run = partial(function, gaussians, inputs, settings, background=background)
    if curve.cut:
        run(seconds=1e-3)  # compiles the kernels
    run(watch=watch, **({"steps": PUBLISHED_STEPS} if curve.cut else {"seconds": marks[-1]}))
    return rows


def average(rows: Sequence[Result]) -> list[Result]:
    """Average each system and mark over the scenes."""
    groups: dict[tuple, list[Result]] = {}
    for row in rows:
        groups.setdefault((row["system"], row["mark"]), []).append(row)
    means = []
    for (system, mark), group in groups.items():
        numbers = ("seconds", "gaussians", "psnr", "ssim", "lpips")
        mean = {
            name: fmean(row[name] for row in group)
            for name in numbers
            if all(row.get(name) is not None for row in group)
        }
        means.append({"system": system, "mark": mark, "scenes": len(group)} | mean)
    return means


def tables(results: Result) -> list[Table]:
    """Show every system on every scene, then the means over scenes."""
    absent = "\n".join(f"not measured: {k}, {why}" for k, why in results["not_measured"].items())
    notes = "\n".join(filter(None, (machine_note(results), NOTES, absent)))
    names = dict.fromkeys(row["scene"] for row in results["rows"])
    shown = [
        make_table(name, ROWS, [row for row in results["rows"] if row["scene"] == name])
        for name in names
    ]
    return [*shown, make_table("means over scenes", MEANS, average(results["rows"]), notes)]


def plot(results: Result) -> Figure:
    """Plot mean PSNR and LPIPS of each system against mean seconds."""
    rows = average(results["rows"])
    metrics = {"psnr": "PSNR of held-out photographs, dB", "lpips": "LPIPS, lower is better"}
    metrics = {name: title for name, title in metrics.items() if all(name in row for row in rows)}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(1.0 + 5.4 * len(metrics), 5.0), layout="constrained")
        grid = figure.subplots(1, len(metrics), squeeze=False)[0]
        for axes, (metric, title) in zip(grid, metrics.items(), strict=True):
            for system in dict.fromkeys(row["system"] for row in rows):
                points = [(r["seconds"], r[metric]) for r in rows if r["system"] == system]
                style = "--" if system.endswith(", cut") else "-"
                color = COLORS[system.removesuffix(", cut")]
                axes.plot(
                    *zip(*points, strict=True),
                    style,
                    color=color,
                    marker="o",
                    ms=4,
                    label=system,
                )
            axes.set(title=title, xlabel="seconds", xscale="log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        grid[0].legend(frameon=False, fontsize=9)
        scenes = dict.fromkeys(row["scene"] for row in results["rows"])
        figure.supxlabel(f"mean over {', '.join(scenes)}", fontsize=9, color=FAINT)
    return figure


ROWS: Columns = {
    "system": text_column("{system}"),
    "mark": text_column("{mark}"),
    "s": number_column("seconds", "{:.1f}"),
    "steps": number_column("steps", "{:,.0f}"),
    "start": text_column("{start}"),
    "Gaussians": number_column("gaussians", "{:,.0f}"),
    "PSNR": number_column("psnr", "{:.2f}"),
    "SSIM": number_column("ssim", "{:.3f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
}
MEANS: Columns = {
    "system": text_column("{system}"),
    "mark": text_column("{mark}"),
    "scenes": text_column("{scenes}"),
    "s": number_column("seconds", "{:.1f}"),
    "Gaussians": number_column("gaussians", "{:,.0f}"),
    "PSNR": number_column("psnr", "{:.2f}"),
    "SSIM": number_column("ssim", "{:.3f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
}
