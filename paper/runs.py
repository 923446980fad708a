"""Write the finished reconstructions below a folder as one page, beside their files."""

import json
import os
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from rich.text import Text

from asysplat.errors import InputError, printable
from asysplat.evaluation.baselines import BASELINES
from asysplat.evaluation.metrics import METRICS
from asysplat.export.gaussians import WRITERS
from asysplat.export.page import PAGE
from asysplat.files import atomic_write, make_folder
from asysplat.root import typed
from asysplat.runs.runs import PICTURE
from asysplat.runs.summary import RECONSTRUCTION_ROWS, metric_cells
from asysplat.terminal import make_console
from paper.grid import Cell, Grid, Heading
from paper.html import TEMPLATES
from paper.reconstructions import (
    COUNTS,
    SHOWN,
    Reconstruction,
    cut,
    read_reconstructions,
)
from paper.terminal import print_grid

PNG = b"\x89PNG\r\n\x1a\n"
GENERATOR = b'<meta name="generator" content="asysplat report">'  # as in base.html.jinja
BESIDE = {"held out": "held_out"}
BESIDE |= {name.replace("_", " "): f"baseline/{name}" for name in BASELINES}
# Options that are shown elsewhere, or change no number.
NOT_SHOWN = ("path", "paths", "run", "output", "open", "view", "video")
# Runs that have these options alike are measured on the same images.
MEASURED_ON = ("path", "frames", "height", "width", "held_out_every", "max_held_out", "metrics")

TITLE = "Reconstructions"
INTRODUCTION = (
    "Held-out photographs measure a reconstruction, which has not seen them. Beside its numbers "
    "stands what one gets without any: one mean color, and the nearest input, copied."
)
CAPTION = (
    "By photographs, the newest first. Bold is the best PSNR in dB of the same photographs, where "
    "the same views of them were held out at the same size."
)
FIGURES = "Means over the images."


class Link(NamedTuple):
    """A link of a page to a file."""

    text: str
    address: str
    size: str


def report_runs(folder: Path, output: Path | None = None) -> None:
    """Write the page of the reconstructions below a folder, and print them as a table.

    Args:
        folder: searched recursively; what is behind links is not read.
        output: the page, .html, or the folder of index.html; None: `folder`.
    """
    if not folder.is_dir():
        raise InputError(f"runs={folder} is no folder: name one that holds reconstructions.")
    runs, left_out = read_reconstructions(folder)
    if not runs:
        damaged = f" but {len(left_out)} that cannot be shown ({left_out[0]})" if left_out else ""
        raise InputError(
            f"runs={folder} has no finished reconstructions{damaged}: make one with "
            f"{typed('reconstruct')} my_scene, or name another folder."
        )
    named = output is not None and output.suffix == PAGE
    page = output if named else (output or folder) / "index.html"
    make_folder(page.parent, "output")
    _check_own(page)
    console = make_console()
    print_grid(make_overview(folder, runs), console)
    for sentence in left_out:
        console.print(Text(f"left out: {sentence}"), soft_wrap=True)
    with atomic_write(page) as partial:
        partial.write_text(render_runs(folder, runs, left_out, page), encoding="utf-8")
    console.print(Text(f"page: {page}"), soft_wrap=True)


def _check_own(page: Path) -> None:
    if not page.is_file():
        return
    with page.open("rb") as file:
        if GENERATOR not in file.read(2000):
            raise InputError(f"{page} is another page: move it, or set output to another folder.")


def make_overview(folder: Path, runs: Sequence[Reconstruction]) -> Grid:
    """Build a line for each reconstruction below `folder`: its numbers, and its own options."""
    names = _short_names({run.options["path"] for run in runs})
    best, own = _best(runs), _own_options(runs)
    headings = [Heading("Reconstruction"), Heading("Photographs")]
    headings += [Heading(METRICS["psnr"], part) for part in BESIDE]
    headings += [Heading(METRICS[metric]) for metric in SHOWN[1:]]
    headings += [Heading(name.capitalize()) for name in COUNTS]
    headings += [Heading("Options")]
    lines = []
    for number, run in enumerate(runs):
        psnrs = [_cell(*metric_cells(run.results, row, ["psnr"])) for row in BESIDE.values()]
        if number in best:
            psnrs[0] = psnrs[0]._replace(style="best")
        lines.append(
            [
                Cell(_name(folder, run), link=f"run-{number}"),
                Cell(names[run.options["path"]]),
                *psnrs,
                *map(_cell, metric_cells(run.results, "held_out", SHOWN[1:])),
                *(Cell(f"{run.results[count]:,.0f}") for count in COUNTS),
                Cell(cut(", ".join(own[number]))),
            ]
        )
    return Grid(CAPTION, headings, lines)


def render_runs(
    folder: Path, runs: Sequence[Reconstruction], left_out: Sequence[str], page: Path
) -> str:
    """Write the page: an overview that links to a section for each reconstruction.

    Args:
        folder: folder that was searched.
        runs, left_out: see `read_reconstructions`.
        page: the file that the page will be; its links are relative to it.
    """
    names, own = _short_names({run.options["path"] for run in runs}), _own_options(runs)
    sections = [
        {
            "anchor": f"run-{number}",
            "photographs": names[run.options["path"]],
            "name": _name(folder, run),
            "pictures": _links(run, page, [PICTURE]),
            "ratio": _ratio(run.folder / PICTURE) if PICTURE in run.sizes else None,
            "grid": _figures(run),
            "counts": {count: f"{run.results[count]:,.0f}" for count in COUNTS},
            "options": own[number],
            "pages": _links(run, page, [f"scene{PAGE}", "path.mp4"]),
            "files": _links(run, page, [f"scene{suffix}" for suffix in WRITERS if suffix != PAGE]),
        }
        for number, run in enumerate(runs)
    ]
    return TEMPLATES.get_template("runs.html.jinja").render(
        title=TITLE,
        introduction=INTRODUCTION,
        overview=make_overview(folder, runs),
        sections=sections,
        left_out=left_out,
    )


def _figures(run: Reconstruction) -> Grid:
    """Build a line for each set of images of a reconstruction, and for each baseline."""
    rows = {
        title: metric_cells(run.results, prefix, SHOWN)
        for title, prefix in RECONSTRUCTION_ROWS.items()
    }
    lines = [[Cell(title), *map(_cell, cells)] for title, cells in rows.items() if any(cells)]
    return Grid(FIGURES, [Heading("Images"), *(Heading(METRICS[m]) for m in SHOWN)], lines)


def _links(run: Reconstruction, page: Path, names: Sequence[str]) -> list[Link]:
    """Link the files that a reconstruction has of these."""
    # A browser resolves ".." in the address, whatever is a link on the disk; so does relpath.
    folder = Path(os.path.relpath(run.folder, page.parent))
    sizes = {name: f"{run.sizes[name] / 1e6:.1f} MB" for name in names if name in run.sizes}
    return [
        Link(name, quote(os.fsencode((folder / name).as_posix())), size)
        for name, size in sizes.items()
    ]


def _ratio(picture: Path) -> float | None:
    """Read width / height of a PNG, not too far from 1 for a page; None if it is damaged."""
    try:
        with picture.open("rb") as file:
            header = file.read(24)
    except OSError:
        return None
    width, height = (int.from_bytes(header[start : start + 4], "big") for start in (16, 20))
    if not header.startswith(PNG) or 0 in (width, height):
        return None
    return round(min(max(width / height, 0.5), 4), 3)


def _best(runs: Sequence[Reconstruction]) -> set[int]:
    """Find, by number, the best of each group that is measured on the same images."""
    groups = defaultdict(list)
    for number, run in enumerate(runs):
        if run.results["held_out/psnr"] is not None:
            keys = sorted(key for key in run.options if key.partition(".")[0] in MEASURED_ON)
            groups[repr([(key, run.options[key]) for key in keys])].append(number)

    compared = [numbers for numbers in groups.values() if len(numbers) > 1]
    return {max(numbers, key=lambda n: runs[n].results["held_out/psnr"]) for numbers in compared}


def _own_options(runs: Sequence[Reconstruction]) -> list[list[str]]:
    """Write, for each reconstruction, the options that others have with other values."""
    texts = [
        {
            key: printable(_value_text(value))
            for key, value in run.options.items()
            if key.partition(".")[0] not in NOT_SHOWN
        }
        for run in runs
    ]
    values = defaultdict(set)
    for options in texts:
        for key, text in options.items():
            values[key].add(text)
    keys = sorted(values, key=lambda key: (key.count("."), key))
    differing = [key for key in keys if len(values[key]) > 1]
    return [
        [cut(f"{printable(key)}={options[key]}") for key in differing if key in options]
        for options in texts
    ]


def _value_text(value: object) -> str:
    """Return a value as it is typed; of a path its name, as a page may go to other people."""
    if isinstance(value, str):
        return Path(value).name if "/" in value else value
    return json.dumps(value, default=str)


def _short_names(paths: Collection[str]) -> dict[str, str]:
    """Return the shortest end of each path that no other has."""
    names = {}
    for path in paths:
        parts, others = Path(path).parts, [Path(other).parts for other in paths if other != path]
        lengths = range(1, len(parts) + 1)
        unique = (n for n in lengths if parts[-n:] not in [other[-n:] for other in others])
        names[path] = printable("/".join(parts[-next(unique, len(parts)) :]) or path)
    return names


def _name(folder: Path, run: Reconstruction) -> str:
    """Return a reconstruction's folder as it is called below `folder`."""
    name = run.folder.relative_to(folder).as_posix()
    return printable(run.folder.absolute().name if name == "." else name)


def _cell(text: str) -> Cell:
    return Cell(text) if text else Cell("-", "muted")
