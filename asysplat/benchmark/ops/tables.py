"""The measurement on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from asysplat.benchmark.ops.measure import PASSES
from asysplat.benchmark.ops.rows import LOOP
from asysplat.benchmark.table import (
    Columns,
    describe_machine_in_words,
    make_table,
    milliseconds,
    show,
    show_limited,
)

MOST_OVER_MATMULS = 2.5  # is asked of ssd
TITLES = {"forward": "Forward", "forward_backward": "Forward and backward"}

Result = Mapping[str, Any]


def tables(results: Result) -> list[Table]:
    """A table for each pass: time, against the sequential loop and bare matmuls; error; memory."""
    rows = results["rows"]
    loop = max((row["loop_tokens"] for row in rows if row["path"] == LOOP), default=0)
    notes = (
        f"{describe_machine_in_words(results['machine'])}\nmedian ± interquartile range\n"
        f"loop: reference.py in fp32 on {loop} tokens, times scaled to the whole sequence\n"
        "matmuls: the operator's matrix products by themselves\n"
        "error: against the reference in float64, relative in L2; *: of a smaller one of its kind"
    )
    return [make_table(TITLES[name], _columns(name), rows, notes, names=3) for name in PASSES]


def _columns(name: str) -> Columns:
    return {
        "operator": lambda row: row["operator"],
        "inputs": lambda row: row["precision"],
        "path": lambda row: row["path"],
        "ms": lambda row: milliseconds(row[name]),
        "loop\n/ path": lambda row: show(_part(row["faster_than_loop"], name), "{:.1f}"),
        "path\n/ matmuls": lambda row: show_limited(
            _part(row["over_matmuls"], name), MOST_OVER_MATMULS
        ),
        "error": lambda row: _error(row, name),
        "kB\n/ token": lambda row: show(_part(row["bytes_per_token"], name, 1e-3), "{:.2f}"),
    }


def _part(values: Mapping[str, float] | None, name: str, unit: float = 1) -> float | None:
    return None if values is None else unit * values[name]


def worst_error(row: Result, name: str) -> float | None:
    """Of the output, or of the gradient that is worst."""
    error = row["error"]
    if error is None:
        return None
    return error["forward"] if name == "forward" else max(error["gradients"].values())


def _error(row: Result, name: str) -> str:
    smaller = row["error"] is not None and row["error"]["measured_on"] != row["sizes"]
    return show(worst_error(row, name), "{:.1e}") + ("*" if smaller else "")
