"""The page: green or red, a table of all areas, and every case in Markdown and in a picture."""

from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.table import Table
from rich.text import Text

from asysplat.benchmark.table import NOTHING, Columns, make_table, number, text
from asysplat.benchmark.timing import Result
from asysplat.report.style import INK, STYLE

GREEN, RED = "#1a7f37", "#cf222e"
LEAST = 1e-6  # share of a tolerance at which the picture ends


def _color(green: bool) -> Text:
    return Text("green", "green") if green else Text("RED", "bold red")


COLUMNS: Columns = {
    "case": text("{case}"),
    "precision": text("{precision}"),
    "worst": lambda row: row["worst"] or NOTHING,
    "error": number("error", "{:.1e}"),
    "tolerance": number("tolerance", "{:.1e}"),
    "NaN": number("nan", "{:,.0f}"),
    "Inf": number("inf", "{:,.0f}"),
    "gradients": lambda row: {True: "finite", False: "not finite", None: NOTHING}[row["gradients"]],
    "compared with": text("{compared}"),
    "": lambda row: _color(row["green"]),
}
SUMMARY: Columns = {
    "area": text("{area}"),
    "cases": number("cases", "{:,.0f}"),
    "red": number("red", "{:,.0f}"),
    "error / tolerance, at most": number("share", "{:.2g}"),
    "NaN": number("nan", "{:,.0f}"),
    "Inf": number("inf", "{:,.0f}"),
    "": lambda row: _color(row["red"] == 0),
}


def verdict(results: Result) -> str | None:
    """Return a sentence if any case is red, else None."""
    rows, red = results["rows"], _red(results["rows"])
    if not red:
        return None
    named = "; ".join(f"{row['area']}: {row['case']} ({row['precision']})" for row in red[:3])
    more = "; ..." if len(red) > 3 else ""
    return f"red: {len(red)} of {len(rows)} cases are not stable: {named}{more}"


def summary(rows: Sequence[Result]) -> list[Result]:
    """Sum up each area.

    Returns:
        "area", "cases", "red", "nan", "inf" and "share": the largest error over its tolerance, None
        where none was measured.
    """
    found = []
    for area in dict.fromkeys(row["area"] for row in rows):
        own = [row for row in rows if row["area"] == area]
        counts = {name: sum(row[name] for row in own) for name in ("nan", "inf")}
        shares = [share for row in own if (share := share_of(row)) is not None]
        found.append(
            {"area": area, "cases": len(own), "red": len(_red(own)), **counts}
            | {"share": max(shares, default=None)}
        )
    return found


def share_of(row: Result) -> float | None:
    """Return the error over the tolerance; None where none was measured."""
    return None if row["error"] is None else row["error"] / row["tolerance"]


def tables(results: Result) -> list[Table]:
    """Show each area, and every case that is red."""
    red = _red(results["rows"])
    machine = ", ".join(f"{key} {value}" for key, value in results["machine"].items())
    notes = f"{machine}\ntolerance: {results['rule']}"
    found = [make_table("Stability", SUMMARY, summary(results["rows"]), notes)]
    if red:
        columns = {"area": text("{area}")} | COLUMNS
        found.append(make_table("Red cases", columns, red, names=4))
    return found


def page(results: Result) -> str:
    """Write the page in Markdown."""
    rows, red = results["rows"], _red(results["rows"])
    machine = ", ".join(f"{key} {value}" for key, value in results["machine"].items())
    state = (
        f"{len(red)} of {len(rows)} cases are RED" if red else f"all {len(rows)} cases are green"
    )
    parts = [
        "# Stability",
        f"**{state}.**",
        "Written by `python benchmark.py suite=stability`, whose exit status is 1 where a case is "
        f"red. Revision {results['revision']}; {machine}.",
        "A case is green if all that comes out and all gradients are finite, and the error is "
        "within its tolerance. Errors are relative, in L2, of the tensor that comes closest to its "
        f'tolerance ("worst"). It is that of {results["rule"]}. A tolerance near 1 says that '
        "float64 decides otherwise as well, or that 16 bits hold no more.",
        _markdown(SUMMARY, summary(rows)),
    ]
    for area in dict.fromkeys(row["area"] for row in rows):
        own = [row for row in rows if row["area"] == area]
        parts += [f"## {area.capitalize()}", _markdown(COLUMNS, own)]
    return "\n\n".join(parts) + "\n"


def _markdown(columns: Columns, rows: Sequence[Result]) -> str:
    lines = [list(columns), ["---"] * len(columns)]
    lines += [[str(write(row)) for write in columns.values()] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |".replace("\n", " ") for line in lines)


def plot(results: Result) -> Figure:
    """Plot the error of each case over its tolerance, an area in each line."""
    rows = results["rows"]
    areas = {row["area"]: line for line, row in enumerate(summary(rows))}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 1.4 + 0.5 * len(areas)), layout="constrained")
        axes = figure.subplots()
        for number_of_row, row in enumerate(rows):
            share = share_of(row)
            # A case of which no error can be told stands where its color puts it.
            place = max(share, LEAST) if share is not None else LEAST if row["green"] else 1e2
            height = areas[row["area"]] + 0.3 * ((number_of_row * 0.618) % 1 - 0.5)
            mark = {"marker": "o" if share is not None else "|", "ms": 4, "alpha": 0.7}
            axes.plot(place, height, color=GREEN if row["green"] else RED, **mark)
        axes.axvline(1, color=INK, lw=1)
        names = [
            f"{row['area']}: {row['cases'] - row['red']} of {row['cases']}" for row in summary(rows)
        ]
        axes.set_yticks(range(len(areas)), names)
        axes.set(xscale="log", xlabel="error / tolerance")
        axes.invert_yaxis()
        keys = [
            Line2D([], [], color=GREEN, marker="o", ls="", label="green"),
            Line2D([], [], color=RED, marker="o", ls="", label="red"),
            Line2D([], [], color=INK, marker="|", ls="", label="no error to measure"),
        ]
        figure.legend(handles=keys, loc="outside right upper", frameon=False)
    return figure


def _red(rows: Sequence[Result]) -> list[Result]:
    return [row for row in rows if not row["green"]]
