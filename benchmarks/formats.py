"""File formats of a scene: size, seconds, and how much rounding changes the pictures."""

import math
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.errors import InputError
from asysplat.export.gaussians import (
    READERS,
    WRITERS,
    cameras_beside,
    read_gaussians,
    read_notes,
    write_gaussians,
)
from asysplat.export.importance import COMPARED_VIEWS, picture_psnr
from asysplat.scene import Gaussians
from benchmarks.compare import DECIBELS, RATIO, TIME, TrackedMetrics
from benchmarks.options import CPU
from benchmarks.table import machine_note, make_table, median_iqr_column, number_column, text_column
from benchmarks.timing import Measurement, Result, measure_run, time_in_rounds

TRACKED = TrackedMetrics(
    names=("format",),
    must_match=("gaussians", "sh_degree"),
    kinds={"megabytes": RATIO, "write": TIME, "read": TIME, "psnr": DECIBELS},
)


def measure(options: DictConfig, console: Console) -> Result:
    """Write a scene in every format and read it back, `options.repeats` times.

    Returns:
        "rows": for each format, its megabytes, seconds to write and to read, and the PSNR of its
        pictures against those of the original.
    """
    if options.formats.scene is None:
        raise InputError("formats.scene is missing: give the scene.ply of a reconstruction.")
    file = Path(options.formats.scene)
    gaussians, notes = read_gaussians(file), read_notes(file)
    cameras = cameras_beside(file, gaussians)
    if cameras is None:
        raise InputError(
            f"formats.scene={file} has no cameras beside it: give the scene.ply of a "
            "reconstruction."
        )
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    common = {"gaussians": gaussians.num_gaussians, "sh_degree": degree}
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"scene{suffix}" for suffix in WRITERS]
        timed = [Measurement(partial(_time_format, path, gaussians)) for path in files]
        time_in_rounds(timed, options.repeats, console)
        rows = []
        for suffix, path, measurement in zip(WRITERS, files, timed, strict=True):
            row = {"format": suffix, "megabytes": path.stat().st_size / 1e6} | common
            row |= {name: measurement.summarize(name) for name in measurement.seconds}
            if path.suffix in READERS:
                written = read_gaussians(path)
                row["psnr"] = picture_psnr(gaussians, written, cameras, **notes.look)
            rows.append(row)
    return {"rows": rows}


def _time_format(path: Path, gaussians: Gaussians) -> dict[str, float]:
    seconds = {"write": measure_run(partial(write_gaussians, path, gaussians), CPU)}
    if path.suffix in READERS:
        seconds["read"] = measure_run(partial(read_gaussians, path), CPU)
    return seconds


def tables(results: Result) -> list[Table]:
    """Show the size, seconds and PSNR of every format."""
    columns = {
        "format": text_column("{format}"),
        "MB": number_column("megabytes", "{:.2f}"),
        "write (s)": median_iqr_column("write", "{:.2f}", unit=1.0),
        "read (s)": median_iqr_column("read", "{:.2f}", unit=1.0),
        "pictures (dB)": number_column("psnr", "{:.1f}"),
    }
    first = results["rows"][0]
    notes = (
        f"{machine_note(results)}\n{first['gaussians']:,} Gaussians, SH degree "
        f"{first['sh_degree']}; PSNR of the pictures against the original's at up to "
        f"{COMPARED_VIEWS} cameras, 100 where they are equal; .html is not read"
    )
    return [make_table("Formats of a scene", columns, results["rows"], notes)]
