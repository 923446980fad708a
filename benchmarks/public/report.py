"""Our rows between published ones: refinements of public scenes, in the published protocols.

A refinement is measured on its way; its clock stands still meanwhile. What a scene took before, to
read its images, is counted apart. Rows that were measured are kept, so that an interrupted suite
goes on where it was.
"""

import hashlib
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import matplotlib
import torch
from hydra.utils import instantiate
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch import Tensor, nn

from asysplat.data.photographs import Photographs
from asysplat.data.selection import evenly_spaced
from asysplat.errors import InputError
from asysplat.evaluation.figures import comparison_figure
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.metrics import nearest_view_images
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.view_images import find_view_files, read_images
from asysplat.files import atomic_write, make_folder, read_json
from asysplat.refinement import PUBLISHED_3DGS, SCAFFOLD_GS, for_views
from asysplat.rendering import Rendering
from asysplat.runs.machine import revision
from asysplat.scene import Views
from benchmarks.compare import DECIBELS, LPIPS_DISTANCE, TrackedMetrics
from benchmarks.options import check_names
from benchmarks.public.protocols import (
    SceneProtocol,
    find_folders,
    open_published,
    read_protocols,
)
from benchmarks.systems import Draw, RefinedSystem, measure_quality, measure_refinement
from benchmarks.table import Columns, machine_text, make_table, number_column, text_column
from benchmarks.timing import Result
from paper.front import AROUND, RIGHT, Name, draw_names
from paper.public import PublishedRow, published_rows, published_sources
from paper.style import FAINT, INK, OURS, PAPER, STYLE

OTHERS = {  # as others schedule a refinement, in our renderer
    "3DGS, in our renderer": RefinedSystem(None, PUBLISHED_3DGS),
    "Scaffold-GS, in our renderer": RefinedSystem(None, SCAFFOLD_GS),
}
TRACKED = TrackedMetrics(
    names=("protocol", "scene", "method", "mark"),
    must_match=("views", "fingerprint"),
    kinds={"psnr": DECIBELS, "lpips": LPIPS_DISTANCE},
)
CURVES = (OURS, INK, "#2f8f4e", "#7a3fb0", FAINT)  # colors of what was measured
PICTURES = 3  # held-out views that are drawn
PANELS = 3  # in a row of the figure


def measure(options: DictConfig, console: Console) -> Result:
    """Measure the systems of `options.public` on all published scenes that `data.root` has.

    Returns:
        "rows": one for each protocol, scene, system and mark. "protocols": what each row's numbers
        depend on, by name. "not_measured": the reason for what was not measured.
    """
    config: Any = OmegaConf.to_container(options.public, resolve=True)
    known = read_protocols()
    names = list(known) if config["protocols"] == "all" else config["protocols"]
    check_names("public.protocols", names, [*known, "all"])
    check_names("public.systems", config["systems"], ["asysplat", *OTHERS])
    if options.data.root is None:
        raise InputError("data.root is null: name a folder of published scenes (data/README.md).")
    found = find_folders(Path(options.data.root), [known[name] for name in names])
    if config["scenes"] != "all":
        check_names("public.scenes", config["scenes"], {scene: 0 for _, scene, _ in found})
        found = [each for each in found if each[1] in config["scenes"]]
    kept = Path(options.output) / "public"
    make_folder(kept, "output")
    rows: list[Result] = []
    absent: dict[str, str] = {}
    for protocol, scene, folder in found:
        measured = PublishedScene(protocol, folder, config, console, kept)
        views = sys.maxsize if protocol.views == "all" else protocol.views
        ours = OmegaConf.merge(for_views(options.refinement, views), config["ours"])
        systems = {"asysplat": RefinedSystem("plane_sweep", instantiate(ours))} | OTHERS
        try:
            for system in config["systems"]:
                rows += measured.rows(system, systems[system])
            for method, images in config["images"].items():
                rows += measured.rows_of_images(method, **images)
        except InputError as error:
            absent[f"{protocol.title}, {scene}"] = str(error)
        if measured.lpips is None:
            absent[f"LPIPS, {protocol.title}"] = measured.metrics.without_lpips()
    if not rows:
        raise InputError("; ".join(absent.values()))
    used = {row["protocol"]: known[row["protocol"]].describe() for row in rows}
    return {"protocols": used, "not_measured": absent, "rows": rows}


@dataclass(frozen=True)
class PublishedScene:
    """Measures systems on one scene in one protocol; the scene is opened when first needed."""

    protocol: SceneProtocol
    folder: Path
    config: Mapping[str, Any]  # options of the suite
    console: Console
    kept: Path  # folder of what was measured

    @cached_property
    def metrics(self) -> Protocol:
        return self.protocol.read_metrics()

    @cached_property
    def lpips(self) -> nn.Module | None:
        return load_lpips(self.metrics.lpips_net, Path(self.config["shared"]) / "weights")

    @cached_property
    def opened(self) -> tuple[Photographs, Result]:
        """The scene, which images were read, and the seconds that this took."""
        clock = time.perf_counter()
        say = partial(self.console.print, highlight=False)
        photographs, images = open_published(self.protocol, self.folder, say)
        return photographs, {"images": images, "reading": time.perf_counter() - clock}

    def rows(self, name: str, system: RefinedSystem) -> list[Result]:
        """Measure a system after each mark and draw its end, or read what was measured."""
        marks, scene = self.config["marks"], self.folder.name
        of = {"protocol": self.protocol.describe(), "folder": str(self.folder), "marks": marks}
        of |= {"system": repr(system), "revision": revision(), "lpips": self.lpips is not None}
        fingerprint = hashlib.blake2b(json.dumps(of).encode(), digest_size=4).hexdigest()
        path = self.kept / f"{self.protocol.name}-{scene}-{fingerprint}.json"
        if path.exists():
            return read_json(path)["rows"]
        photographs, of_images = self.opened
        targets = photographs.held_out
        self.console.print(f"{self.protocol.title}, {escape(scene)}: {name}", highlight=False)
        count = min(self.config["curve_views"], targets.num_views)
        some = targets.select(evenly_spaced(range(targets.num_views), count))

        def quality(draw: Draw, last: bool) -> Result:
            if last:
                draw_views(path.with_suffix(".png"), photographs, draw)
            return self._measure(targets if last else some, draw)

        nearest = in_turn(nearest_view_images(photographs.inputs, some))
        rows = [self._row("nearest input, copied", None) | self._measure(some, nearest)]
        # A refinement that ends early has the same row at all later marks.
        found = {
            row["steps"]: row for row in measure_refinement(photographs, system, marks, quality)
        }
        rows += [self._row(name, row["mark"]) | row | of_images for row in found.values()]
        rows = [row | {"fingerprint": fingerprint} for row in rows]
        with atomic_write(path) as partial_path:
            partial_path.write_text(json.dumps({"of": of, "rows": rows}, indent=1))
        return rows

    def rows_of_images(self, method: str, folder: str, seconds: float | int) -> list[Result]:
        """Measure what another program rendered after so many seconds."""
        photographs, of_images = self.opened
        targets, names = photographs.held_out, photographs.held_out_files
        place = Path(folder) / self.protocol.name / self.folder.name
        files = find_view_files(place, [Path(name).stem for name in names])
        images = read_images(files, targets.cameras.height, targets.cameras.width).images
        row = self._row(method, seconds) | {"seconds": seconds} | of_images
        return [row | self._measure(targets, in_turn(images))]

    def _row(self, method: str, mark: float | int | None) -> Result:
        return {
            "protocol": self.protocol.name,
            "scene": self.folder.name,
            "method": method,
            "mark": mark,
        }

    def _measure(self, views: Views, draw: Draw) -> Result:
        count = {"views": views.num_views}
        return count | measure_quality(self.metrics, views, self.lpips, draw)


def draw_views(path: Path, photographs: Photographs, draw: Draw) -> None:
    """Draw some held-out views beside their photographs."""
    targets = photographs.held_out
    some = targets.select(evenly_spaced(range(targets.num_views), min(PICTURES, targets.num_views)))
    image = torch.cat([draw(some.cameras.select([view])) for view in range(some.num_views)])
    rendering = Rendering(image, torch.ones_like(image[:, 0]), depth=None, stats={})
    with atomic_write(path) as partial_path:
        figure = comparison_figure(photographs.inputs, some, rendering)
        figure.savefig(partial_path, format="png", dpi=200)


def in_turn(images: Tensor) -> Draw:
    """Return a function that draws one image after the other."""
    left = iter(images[:, None])
    return lambda _: next(left)


def merged_rows(rows: Sequence[Result], protocol: str, scene: str) -> list[Result]:
    """Sort our rows and the published ones by PSNR, best first.

    Published means over scenes stand in where nothing is published of the scene itself.
    """
    own = [row for row in rows if (row["protocol"], row["scene"]) == (protocol, scene)]
    others = published_rows(protocol, scene) or published_rows(protocol, "mean")
    return sorted([*own, *map(describe_row, others)], key=lambda row: -row["psnr"])


def describe_row(row: PublishedRow) -> Result:
    """Return a published row as one of ours."""
    method = row.method if row.scenes is None else f"{row.method}, mean of {row.scenes}"
    source = ", ".join(filter(None, (row.source, row.hardware)))
    return asdict(row) | {"method": method, "source": source, "mark": None}


def tables(results: Result) -> list[Table]:
    """Show each scene in each protocol, with the published rows between ours."""
    protocols = read_protocols()
    shown, used = [], set()
    for protocol, scene in scenes_of(results):
        rows = merged_rows(results["rows"], protocol, scene)
        metrics = protocols[protocol].read_metrics().describe()
        notes = [f"{name}: {metrics[name]}" for name in ("psnr", "ssim", "lpips")]
        notes.append(f"images: {', '.join({row['images'] for row in rows if 'images' in row})}")
        title = f"{protocols[protocol].title}: {scene}"
        used |= {row["source"].partition(",")[0] for row in rows if "source" in row}
        views = sorted({row["views"] for row in rows if "views" in row})
        if len(views) > 1:
            notes.append(f"own rows but the last are of {views[0]} of the {views[-1]} images")
        shown.append(make_table(title, COLUMNS, rows, "\n".join(notes)))
    absent = [f"not measured: {name}: {why}" for name, why in results["not_measured"].items()]
    own = f"own rows: {machine_text(results)}, revision {results['revision']}"
    sources = [f"{name}: {text}" for name, text in published_sources().items() if name in used]
    shown[-1].caption = "\n".join([str(shown[-1].caption), own, *absent, *sources])
    return shown


def scenes_of(results: Result) -> list[tuple[str, str]]:
    """List protocols and scenes that were measured."""
    return list(dict.fromkeys((row["protocol"], row["scene"]) for row in results["rows"]))


def plot(results: Result) -> Figure:
    """Plot PSNR over seconds: curves of what ran on this machine, published rows as points."""
    scenes, protocols = scenes_of(results), read_protocols()
    own = dict.fromkeys(row["method"] for row in results["rows"] if row["mark"])
    colors = dict(zip(own, CURVES, strict=False))
    columns = min(PANELS, len(scenes))
    lines = math.ceil(len(scenes) / columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(1.0 + 5.4 * columns, 4.4 * lines), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False).flat
        names = {}
        for axes, (protocol, scene) in zip(grid, scenes, strict=False):
            names[axes] = _plot_rows(axes, merged_rows(results["rows"], protocol, scene), colors)
            axes.set_title(f"{protocols[protocol].title}: {scene}")
        for axes, those in names.items():
            draw_names(axes, those, 7)
        for name, color in colors.items():  # the first panel may lack some
            figure.axes[0].plot([], [], "-o", ms=4, color=color, label=name)
        figure.axes[0].legend(frameon=False, fontsize=9)
        seconds = "seconds: dots on this machine's CPU, crosses and lines as published, on GPUs"
        figure.supxlabel(seconds, color=FAINT)
        figure.supylabel("PSNR of held-out images, dB")
        for axes in figure.axes[len(scenes) :]:
            axes.remove()
    return figure


def _plot_rows(axes: Axes, rows: Sequence[Result], colors: Mapping[str, str]) -> list[Name]:
    """Plot the rows of a scene; return the names of published ones, still to be drawn."""
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(0.08)
    own = [row for row in rows if row["mark"]]
    for name in dict.fromkeys(row["method"] for row in own):
        points = [(row["seconds"], row["psnr"]) for row in own if row["method"] == name]
        axes.plot(*zip(*sorted(points), strict=True), "-o", ms=4, color=colors[name])
    measured = [row["seconds"] for row in own]
    first, last = min(measured), max(measured)
    names: list[Name] = []
    for row in (row for row in rows if "source" in row):
        seconds, level = row["seconds"], row["psnr"]
        if seconds is None:  # a level, named on the right of what was measured
            axes.hlines(level, first, last, color=PAPER, lw=0.5)
            axes.set_xlim(right=last * last / first)
            names.append(((row["method"], last, level), FAINT, (RIGHT,)))
        else:
            axes.plot(seconds, level, "x", color=PAPER)
            names.append(((row["method"], seconds, level), FAINT, AROUND))
    return names


COLUMNS: Columns = {
    "method": text_column("{method}"),
    "s": number_column("seconds", "{:,.0f}"),
    "Gaussians": number_column("gaussians", "{:,.0f}k", unit=1e3),
    "PSNR": number_column("psnr", "{:.2f}"),
    "SSIM": number_column("ssim", "{:.3f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
    "source": lambda row: row.get("source", "-"),
}
