"""The measurement on the terminal."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.box import ROUNDED
from rich.table import Table
from rich.text import Text

from asysplat.benchmark.render.stages import STAGES

# What is asked of the cpu backend with all its skips.
MOST_OVER_FLOOR = 2.5
MOST_WHOLE_OVER_RASTER = 2.0
DIRECTIONS = ("forward", "backward")

Result = Mapping[str, Any]


def tables(results: Result) -> list[Table]:
    """Time and error of every row; what the cpu backend's time goes into; how near that is to the
    least there could be."""
    rows = results["rows"]
    ours = [row for row in rows if row["backend"] == "cpu" and row["without"] is None]
    machine = ", ".join(f"{key} {value}" for key, value in results["machine"].items())
    notes = (
        f"{machine}\nmedian ± interquartile range; *: errors of a smaller scene of the same make;\n"
        "errors outside the pixels where some backend's rounding decides otherwise at a cut-off"
    )
    return [
        _table("Every backend, and without one of its skips", COLUMNS, rows, notes),
        _table("Stages of the cpu backend, ms", STAGE_COLUMNS, ours),
        _table(
            "The cpu backend's limits",
            LIMIT_COLUMNS,
            [(row, direction) for row in ours for direction in DIRECTIONS],
            f"asked for: raster / floor at most {MOST_OVER_FLOOR}, whole / raster at most "
            f"{MOST_WHOLE_OVER_RASTER}",
        ),
    ]


def _table(
    title: str,
    columns: Mapping[str, Callable[[Any], str | Text]],
    rows: Sequence[Any],
    notes: str | None = None,
) -> Table:
    """A column for each function of a row, under its heading; the first ones are names."""
    table = Table(title=title, caption=notes, box=ROUNDED)
    for heading in columns:
        words = heading in ("scene", "backend", "pass")
        table.add_column(heading, justify="left" if words else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(show(row) for show in columns.values()))
    return table


def _name(row: Result) -> str:
    return row["backend"] if row["without"] is None else f"  no {row['without']} skip"


def _milliseconds(seconds: Result) -> str:
    return f"{1000 * seconds['median']:.1f} ± {1000 * seconds['iqr']:.1f}"


def _error(row: Result, value: float) -> str:
    twin = any(row[key] != size for key, size in row["error"]["measured_on"].items())
    return f"{value:.1e}{'*' if twin else ''}"


def _limited(value: float, limit: float) -> Text:
    return Text(f"{value:.2f}", style="bold red" if value > limit else "")


COLUMNS = {
    "scene": lambda row: row["scene"],
    "backend": _name,
    "forward\nms": lambda row: _milliseconds(row["forward"]),
    "backward\nms": lambda row: _milliseconds(row["backward"]),
    "memory\nMB": lambda row: f"{1000 * row['peak_gb']:.0f}",
    "image\np99": lambda row: _error(row, row["error"]["image_p99"]),
    "image\nmax": lambda row: _error(row, row["error"]["image_max"]),
    "flips\n1e-6": lambda row: f"{1e6 * row['error']['flipped']:.0f}",
    "gradients\nworst": lambda row: _error(row, max(row["error"]["gradients"].values())),
}
STAGE_COLUMNS = {
    "scene": lambda row: row["scene"],
    **{
        stage.replace("_", "\n"): lambda row, stage=stage: _milliseconds(row["stages"][stage])
        for stage in STAGES
    },
}
LIMIT_COLUMNS = {
    "scene": lambda pair: pair[0]["scene"],
    "pass": lambda pair: pair[1],
    "rows\nmillions": lambda pair: f"{pair[0]['stats']['rows'] / 1e6:.2f}",
    "hot row\nns": lambda pair: f"{1e9 * pair[0]['raster'][pair[1]]['hot_row']:.1f}",
    "floor\nms": lambda pair: f"{1000 * pair[0]['raster'][pair[1]]['floor']:.1f}",
    "raster\n/ floor": lambda pair: _limited(
        pair[0]["raster"][pair[1]]["over_floor"], MOST_OVER_FLOOR
    ),
    "whole\n/ raster": lambda pair: _limited(
        pair[0]["raster"][pair[1]]["whole_over_raster"], MOST_WHOLE_OVER_RASTER
    ),
    "reference\n/ cpu": lambda pair: f"{pair[0]['faster_than_reference'][pair[1]]:.1f}",
}
