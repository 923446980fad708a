"""Write the finished reconstructions below a folder as one page, beside their files."""

import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from omegaconf import OmegaConf

from asysplat.errors import InputError
from asysplat.evaluation.metrics import BASELINES, METRICS
from asysplat.export.gaussians import WRITERS
from asysplat.export.mesh import MESHES
from asysplat.export.page import PAGE
from asysplat.files import atomic_write, make_folder, read_json
from asysplat.root import typed
from asysplat.runs.run_config import flat_options
from asysplat.runs.runs import PICTURE, RECONSTRUCTION, RESULTS, files_below
from asysplat.runs.summary import metric_cells, missing_metrics
from asysplat.terminal import make_console
from paper.grid import Cell, Grid, Heading
from paper.html import TEMPLATES
from paper.terminal import print_grid

INDEX = "reconstructions.html"
SUFFIXES = (*(suffix for suffix in WRITERS if suffix != PAGE), *MESHES)
FILES = (f"scene{PAGE}", "path.mp4", *(f"scene{suffix}" for suffix in SUFFIXES))
PSNRS = {"held out": "held_out"}
PSNRS |= {name.replace("_", " "): f"baseline/{name}" for name in BASELINES}
# Options that are shown elsewhere, or change no number.
NOT_SHOWN = ("path", "paths", "run", "output", "open", "view", "video")
CAPTION = (
    "By photographs, the newest first. Held-out photographs measure a reconstruction, which has "
    "not seen them; beside its PSNR in dB stands what one gets without any: one mean color, and "
    "the nearest input, copied."
)


class Reconstruction(NamedTuple):
    """A finished reconstruction."""

    folder: Path
    results: dict[str, Any]  # content of metrics.json
    options: dict[str, Any]  # content of config.yaml, by dotted keys


def report_reconstructions(folder: Path, output: Path | None = None) -> None:
    """Write the page of the reconstructions below a folder, and print them as a table.

    Args:
        folder: searched recursively.
        output: the folder of the page; None: `folder`.
    """
    runs = read_reconstructions(folder)
    if not runs:
        raise InputError(
            f"runs={folder} has no finished reconstructions: make one with "
            f"{typed('reconstruct')} my_scene, or name another folder."
        )
    page = (output or folder) / INDEX
    make_folder(page.parent, "output")
    overview, console = make_overview(folder, runs), make_console()
    print_grid(overview, console)
    template = TEMPLATES.get_template("reconstructions.html.jinja")
    sections = [(f"run-{number}", run, link_files(run, page)) for number, run in enumerate(runs)]
    with atomic_write(page) as partial:
        text = template.render(title="Reconstructions", overview=overview, sections=sections)
        partial.write_text(text, encoding="utf-8")
    console.print(f"page: {page}", soft_wrap=True)


def read_reconstructions(folder: Path) -> list[Reconstruction]:
    """Read the finished reconstructions below a folder: by photographs, the newest first."""
    runs = []
    for path in reversed(files_below(folder, RESULTS)):
        if any((path.parent / name).exists() for name in RECONSTRUCTION):
            options = OmegaConf.to_container(OmegaConf.load(path.parent / "config.yaml"))
            runs.append(Reconstruction(path.parent, read_json(path), flat_options(options)))
    return sorted(runs, key=lambda run: Path(run.options["path"]).name.casefold())


def make_overview(folder: Path, runs: Sequence[Reconstruction]) -> Grid:
    """Build a line for each reconstruction: its numbers, and the options that others lack."""
    values = defaultdict(set)
    for run in runs:
        for key, value in run.options.items():
            values[key].add(str(value))
    differing = [
        key
        for key in sorted(values, key=lambda key: (key.count("."), key))
        if len(values[key]) > 1 and key.partition(".")[0] not in NOT_SHOWN
    ]
    headings = [Heading("Reconstruction"), Heading("Photographs")]
    headings += [Heading(METRICS["psnr"], part) for part in PSNRS]
    titles = (METRICS["ssim"], METRICS["lpips"], "Gaussians", "Steps", "Seconds", "Options")
    headings += map(Heading, titles)
    lines = []
    for number, run in enumerate(runs):
        cells = [Path(run.options["path"]).name]
        for row in PSNRS.values():
            cells += metric_cells(run.results, row, ["psnr"])
        cells += metric_cells(run.results, "held_out", ["ssim", "lpips"])
        cells += [f"{run.results[count]:,.0f}" for count in ("gaussians", "steps", "seconds")]
        cells += [", ".join(f"{key}={run.options[key]}" for key in differing if key in run.options)]
        name = run.folder.relative_to(folder).as_posix()
        lines.append([Cell(name, link=f"run-{number}"), *map(Cell, cells)])
    missing = dict.fromkeys(text for run in runs for text in missing_metrics(run.results))
    return Grid(" ".join([CAPTION, *missing]), headings, lines)


def link_files(run: Reconstruction, page: Path) -> dict[str, str]:
    """Return the addresses, relative to the page, of a reconstruction's picture and files."""
    folder = Path(os.path.relpath(run.folder, page.parent))
    names = [name for name in (PICTURE, *FILES) if (run.folder / name).exists()]
    return {name: quote((folder / name).as_posix()) for name in names}
