"""Read the finished reconstructions below a folder, which may come from strangers."""

import os
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import OmegaConf

from asysplat.errors import InputError, printable
from asysplat.runs.run_config import flat_options, read_config
from asysplat.runs.runs import RECONSTRUCTION, RESULTS
from asysplat.runs.summary import RECONSTRUCTION_ROWS, read_results

CONFIG = "config.yaml"
MAX_TEXT = 60  # characters of a value
COUNTS = ("gaussians", "steps", "seconds")
SHOWN = ("psnr", "ssim", "lpips")


class Reconstruction(NamedTuple):
    """A finished reconstruction."""

    folder: Path
    finished: float  # time
    results: dict[str, int | float | None]  # numbers of metrics.json that are shown
    options: dict[str, Any]  # options of config.yaml, by dotted keys
    sizes: dict[str, int]  # bytes of its files, by name


def read_reconstructions(folder: Path) -> tuple[list[Reconstruction], list[str]]:
    """Read the finished reconstructions below a folder.

    Returns:
        The reconstructions by photographs, the newest first, and a sentence for each that is
        damaged or unfinished.
    """
    runs, left_out = [], []
    for place, _, files in os.walk(folder):  # goes through no link
        if not set(RECONSTRUCTION) & set(files):
            continue
        try:
            runs.append(_read_run(Path(place)))
        except (InputError, OSError) as error:
            left_out.append(printable(str(error).replace(f"{folder}{os.sep}", "")))

    def order(run: Reconstruction) -> tuple:
        path = run.options["path"]
        return Path(path).name.casefold(), path, -run.finished, run.folder

    return sorted(runs, key=order), sorted(left_out)


def _read_run(folder: Path) -> Reconstruction:
    """Read a folder that a stranger may have made: nothing in it is resolved, built or run."""
    with os.scandir(folder) as entries:
        stats = {
            entry.name: entry.stat(follow_symlinks=False)
            for entry in entries
            if entry.is_file(follow_symlinks=False)
        }
    for name in (CONFIG, RESULTS):
        if name not in stats:
            raise InputError(f"{folder} is unfinished: it has no {name} of its own.")
    found = read_results(folder / RESULTS)
    for key in COUNTS:
        if found.get(key) is None:
            raise InputError(f"{folder / RESULTS} has nothing as {key}: copy the run again.")
    measured = [f"{row}/{metric}" for row in RECONSTRUCTION_ROWS.values() for metric in SHOWN]
    results = {key: found.get(key) for key in (*COUNTS, *measured)}
    options = flat_options(OmegaConf.to_container(read_config(folder / CONFIG)))
    if not isinstance(options.get("path"), str):
        raise InputError(f"{folder / CONFIG} has no path of photographs: copy the run again.")
    sizes = {name: stat.st_size for name, stat in stats.items()}
    return Reconstruction(folder, stats[RESULTS].st_mtime, results, options, sizes)


def cut(text: str) -> str:
    """Return a text, or its beginning if it is long."""
    return text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 3]}..."
