"""The measurement on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from asysplat.benchmark.table import (
    Columns,
    describe_machine_in_words,
    make_table,
    milliseconds,
    show,
    show_limited,
)

MOST_OVER_FLOOR = 2.5  # is asked of the forward pass

Result = Mapping[str, Any]


def tables(results: Result) -> list[Table]:
    """Every network; what its forward pass goes into; where views vary, the time of each."""
    rows = results["rows"]
    network_notes = (
        f"{describe_machine_in_words(results['machine'])}\nmedian ± interquartile range\n"
        "floor: the forward pass's matrix products and convolutions by themselves; a step's is "
        "three times that\nstep: forward and backward; -: not asked for, or would not fit into "
        "memory\n"
        "/ first: to the first model at this precision and number of views\n"
        "tokens: those of the largest patch"
    )
    part_notes = "of which: operators, within the components that call them"
    parts = [part for row in rows for part in _parts(row)]
    shown = [
        make_table("Networks", NETWORKS, rows, network_notes, names=2),
        make_table("What a forward pass goes into", PARTS, parts, part_notes, names=3),
    ]
    if len({row["views"] for row in rows}) > 1:
        shown.append(
            make_table("Milliseconds of a forward pass for each view", VIEWS, rows, names=2)
        )
    return shown


def _parts(row: Result) -> list[Result]:
    """A line for each component and, below, for each operator."""
    named = {key: row[key] for key in ("model", "views", "precision")}
    whole = row["forward"]["median"]
    lines = [{"part": name, **values} for name, values in row["components"].items()]
    lines += [
        {"part": f"  of which {name}", "seconds": seconds, "floor": None}
        for name, seconds in row["operators"].items()
    ]
    return [named | line | {"share": line["seconds"]["median"] / whole} for line in lines]


def _over_floor(part: Result) -> float | None:
    return part["seconds"]["median"] / part["floor"] if part["floor"] else None


def _kilobytes(row: Result, name: str) -> str:
    value = row["bytes_per_token"].get(name)
    return show(value and 1e-3 * value, "{:,.0f}")


def _per_view(row: Result, seconds: Mapping[str, float] | None) -> str:
    return show(seconds and 1000 * seconds["median"] / row["views"], "{:.2f}")


def _operator(name: str) -> Any:
    return lambda row: _per_view(row, row["operators"].get(name))


NETWORKS: Columns = {
    "model": lambda row: row["model"],
    "inputs": lambda row: f"{row['views']} x {row['height']}x{row['width']}, {row['precision']}",
    "forward\nms": lambda row: milliseconds(row["forward"]),
    "floor\nms": lambda row: milliseconds(row["floor"]),
    "forward\n/ floor": lambda row: show_limited(row["over_floor"]["forward"], MOST_OVER_FLOOR),
    "forward\n/ first": lambda row: show(row["over_first"]["forward"], "{:.2f}"),
    "step\nms": lambda row: milliseconds(row["step"]),
    "step\n/ floor": lambda row: show(row["over_floor"]["step"], "{:.2f}"),
    "step\n/ first": lambda row: show(row["over_first"]["step"], "{:.2f}"),
    "forward\nkB / token": lambda row: _kilobytes(row, "forward"),
    "step\nkB / token": lambda row: _kilobytes(row, "step"),
    "step\nGB": lambda row: show(row["peak_gb"].get("step"), "{:.2f}"),
}
PARTS: Columns = {
    "model": lambda part: part["model"],
    "inputs": lambda part: f"{part['views']} views, {part['precision']}",
    "component": lambda part: part["part"],
    "ms": lambda part: milliseconds(part["seconds"]),
    "share\n%": lambda part: f"{100 * part['share']:.1f}",
    "floor\nms": lambda part: show(part["floor"] and 1000 * part["floor"], "{:.1f}"),
    "/ floor": lambda part: show(_over_floor(part), "{:.2f}"),
}
VIEWS: Columns = {
    "model": lambda row: row["model"],
    "inputs": lambda row: f"{row['views']} views, {row['precision']}",
    "all": lambda row: _per_view(row, row["forward"]),
    "appearance\nlayers": lambda row: _per_view(
        row, row["components"].get("MambaVision", {}).get("seconds")
    ),
    "ssd": _operator("ssd"),
    "selective\nscan": _operator("selective_scan"),
    "grid\nattention": _operator("grid_attention"),
}
