"""The measurement on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from asysplat.benchmark.render.stages import STAGES
from asysplat.benchmark.table import (
    describe_machine_in_words,
    make_table,
    milliseconds,
    show_limited,
)

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
    notes = (
        f"{describe_machine_in_words(results['machine'])}\n"
        "median ± interquartile range; *: errors of a smaller scene of the same make;\n"
        "errors outside the pixels where some backend's rounding decides otherwise at a cut-off"
    )
    return [
        make_table("Every backend, and without one of its skips", COLUMNS, rows, notes, names=2),
        make_table("Stages of the cpu backend, ms", STAGE_COLUMNS, ours),
        make_table(
            "The cpu backend's limits",
            LIMIT_COLUMNS,
            [(row, direction) for row in ours for direction in DIRECTIONS],
            f"asked for: raster / floor at most {MOST_OVER_FLOOR}, whole / raster at most "
            f"{MOST_WHOLE_OVER_RASTER}",
            names=2,
        ),
    ]


def _name(row: Result) -> str:
    return row["backend"] if row["without"] is None else f"  no {row['without']} skip"


def _error(row: Result, value: float) -> str:
    twin = any(row[key] != size for key, size in row["error"]["measured_on"].items())
    return f"{value:.1e}{'*' if twin else ''}"


COLUMNS = {
    "scene": lambda row: row["scene"],
    "backend": _name,
    "forward\nms": lambda row: milliseconds(row["forward"]),
    "backward\nms": lambda row: milliseconds(row["backward"]),
    "memory\nMB": lambda row: f"{1000 * row['peak_gb']:.0f}",
    "image\np99": lambda row: _error(row, row["error"]["image_p99"]),
    "image\nmax": lambda row: _error(row, row["error"]["image_max"]),
    "flips\n1e-6": lambda row: f"{1e6 * row['error']['flipped']:.0f}",
    "gradients\nworst": lambda row: _error(row, max(row["error"]["gradients"].values())),
}
STAGE_COLUMNS = {
    "scene": lambda row: row["scene"],
    **{
        stage.replace("_", "\n"): lambda row, stage=stage: milliseconds(row["stages"][stage])
        for stage in STAGES
    },
}
LIMIT_COLUMNS = {
    "scene": lambda pair: pair[0]["scene"],
    "pass": lambda pair: pair[1],
    "rows\nmillions": lambda pair: f"{pair[0]['stats']['rows'] / 1e6:.2f}",
    "hot row\nns": lambda pair: f"{1e9 * pair[0]['raster'][pair[1]]['hot_row']:.1f}",
    "floor\nms": lambda pair: f"{1000 * pair[0]['raster'][pair[1]]['floor']:.1f}",
    "raster\n/ floor": lambda pair: show_limited(
        pair[0]["raster"][pair[1]]["over_floor"], MOST_OVER_FLOOR
    ),
    "whole\n/ raster": lambda pair: show_limited(
        pair[0]["raster"][pair[1]]["whole_over_raster"], MOST_WHOLE_OVER_RASTER
    ),
    "reference\n/ cpu": lambda pair: f"{pair[0]['faster_than_reference'][pair[1]]:.1f}",
}
