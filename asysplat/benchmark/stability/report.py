"""The suite: measure every case, and show which are red in tables, a page and a figure."""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text

from asysplat.benchmark.compare import ERROR, Watched
from asysplat.benchmark.options import check_names
from asysplat.benchmark.stability.comparison import RULE, StabilityCase
from asysplat.benchmark.stability.models import network_cases, plane_sweep_cases, prior_cases
from asysplat.benchmark.stability.operators import operator_cases
from asysplat.benchmark.stability.optimization import refinement_cases, training_cases
from asysplat.benchmark.stability.renderer import renderer_cases
from asysplat.benchmark.table import NOTHING, Columns, make_table, markdown, number, text
from asysplat.benchmark.timing import Result
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.report.style import INK, STYLE
from asysplat.training.revision import revision

AREAS: dict[str, Callable[[DictConfig], Iterable[StabilityCase]]] = {
    "operators": lambda options: chain(operator_cases(), plane_sweep_cases()),
    "prior": lambda options: prior_cases(options.views),
    "renderer": lambda options: renderer_cases(options.views),
    "network": lambda options: network_cases(options.models, options.overrides, options.views),
    "training": lambda options: training_cases(options.models, options.training_steps),
    "refinement": lambda options: refinement_cases(options.refinement_steps),
}
WATCHED = Watched(names=("area", "case", "precision"), alike=(), kinds={"error": ERROR})
GREEN, RED = "#1a7f37", "#cf222e"
MIN_SHARE = 1e-6  # of a tolerance: the figure's left end


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


def measure(options: DictConfig, console: Console) -> Result:
    """Measure every case of the areas `options.stability.areas`, on the CPU.

    Returns:
        "revision" of the code; "rule" of the tolerances; "rows": see `comparison.make_row`, and
        "area", "case" and "precision".

    Raises:
        InputError: an unknown area or model, a number below 1.
    """
    options = options.stability
    check_names("stability.areas", options.areas, AREAS)
    check_overrides([f"model={model}" for model in options.models])
    counts = {f"views={list(options.views)}": options.views}
    counts |= {f"{n}={options[n]}": [options[n]] for n in ("training_steps", "refinement_steps")}
    for setting, values in counts.items():
        if not all(isinstance(value, int) and value >= 1 for value in values):
            raise InputError(f"stability.{setting} cannot be: give whole numbers from 1.")
    cases = [case for area in options.areas for case in AREAS[area](options)]
    rows = [case.row() for case in track(cases, "cases", console=console)]
    return {"revision": revision(), "rule": RULE, "rows": rows}


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
        without errors.
    """
    areas = []
    for area in dict.fromkeys(row["area"] for row in rows):
        own = [row for row in rows if row["area"] == area]
        areas.append(
            {"area": area, "cases": len(own), "red": len(_red(own))}
            | {name: sum(row[name] for row in own) for name in ("nan", "inf")}
            | {"share": max(filter(None.__ne__, map(_share, own)), default=None)}
        )
    return areas


def tables(results: Result) -> list[Table]:
    """Make a table of the areas, and one of the red cases if there are any."""
    red = _red(results["rows"])
    notes = f"{_machine(results)}\ntolerance: {results['rule']}"
    shown = [make_table("Stability", SUMMARY, summary(results["rows"]), notes)]
    if red:
        shown.append(make_table("Red cases", {"area": text("{area}")} | COLUMNS, red, names=4))
    return shown


def page(results: Result) -> str:
    """Write a page of all cases in Markdown."""
    rows, red = results["rows"], _red(results["rows"])
    state = (
        f"{len(red)} of {len(rows)} cases are RED" if red else f"all {len(rows)} cases are green"
    )
    parts = [
        "# Stability",
        f"**{state}.**",
        "Written by `python benchmark.py suite=stability`; its exit status is 1 if a case is red. "
        f"Revision {results['revision']}; {_machine(results)}.",
        "A case is green if all results and gradients are finite, and the error is within its "
        "tolerance. Errors are relative, in L2, of the tensor that comes closest to its tolerance "
        f'("worst"). The tolerance is that of {results["rule"]}. A tolerance near 1 means that '
        "float64 is as badly conditioned, or that 16 bits cannot hold more.",
        markdown(make_table("Areas", SUMMARY, summary(rows))),
    ]
    for area in dict.fromkeys(row["area"] for row in rows):
        own = [row for row in rows if row["area"] == area]
        parts.append(markdown(make_table(area.capitalize(), COLUMNS, own, names=3)))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def plot(results: Result) -> Figure:
    """Plot the error of each case over its tolerance, an area in each line."""
    areas = summary(results["rows"])
    heights = {row["area"]: line for line, row in enumerate(areas)}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 1.4 + 0.5 * len(areas)), layout="constrained")
        axes = figure.subplots()
        for index, row in enumerate(results["rows"]):
            share = _share(row)
            # A case without an error is drawn at the end that its color stands for.
            place = (
                max(share, MIN_SHARE) if share is not None else MIN_SHARE if row["green"] else 1e2
            )
            height = heights[row["area"]] + 0.3 * ((index * 0.618) % 1 - 0.5)
            mark = {"marker": "o" if share is not None else "|", "ms": 4, "alpha": 0.7}
            axes.plot(place, height, color=GREEN if row["green"] else RED, **mark)
        axes.axvline(1, color=INK, lw=1)
        names = [f"{row['area']}: {row['cases'] - row['red']} of {row['cases']}" for row in areas]
        axes.set_yticks(range(len(areas)), names)
        axes.set(xscale="log", xlabel="error / tolerance")
        axes.invert_yaxis()
        keys = (("green", GREEN, "o"), ("red", RED, "o"), ("no error to measure", INK, "|"))
        lines = [Line2D([], [], color=c, marker=mark, ls="", label=name) for name, c, mark in keys]
        figure.legend(handles=lines, loc="outside right upper", frameon=False)
    return figure


def _share(row: Result) -> float | None:
    """Return the error over the tolerance, None without an error."""
    return None if row["error"] is None else row["error"] / row["tolerance"]


def _red(rows: Sequence[Result]) -> list[Result]:
    return [row for row in rows if not row["green"]]


def _machine(results: Result) -> str:
    return ", ".join(f"{key} {value}" for key, value in results["machine"].items())
