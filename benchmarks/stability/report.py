"""The suite: measure every case, and show which are red."""

from collections.abc import Callable, Iterable, Sequence

from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from benchmarks.compare import ERROR, Watched
from benchmarks.options import check_names
from benchmarks.plot import bars
from benchmarks.stability.comparison import RULE, StabilityCase
from benchmarks.stability.models import depth_cases, network_cases
from benchmarks.stability.operators import operator_cases
from benchmarks.stability.optimization import refinement_cases, training_cases
from benchmarks.stability.renderer import renderer_cases
from benchmarks.table import NOTHING, Columns, make_table, number, text
from benchmarks.timing import Result

AREAS: dict[str, Callable[[DictConfig], Iterable[StabilityCase]]] = {
    "operators": lambda options: [*operator_cases(), *depth_cases(plane_sweep=True)],
    "prior": lambda options: depth_cases(False, options.views),
    "renderer": lambda options: renderer_cases(options.views),
    "network": lambda options: network_cases(options.models, options.overrides, options.views),
    "training": lambda options: training_cases(options.models, options.training_steps),
    "refinement": lambda options: refinement_cases(options.refinement_steps),
}
WATCHED = Watched(names=("area", "case", "precision"), alike=(), kinds={"error": ERROR})


COLUMNS: Columns = {
    "case": text("{case}"),
    "precision": text("{precision}"),
    "worst": lambda row: row["worst"] or NOTHING,
    "error": number("error", "{:.1e}"),
    "tolerance": number("tolerance", "{:.1e}"),
    "NaN": number("nan", "{:,.0f}"),
    "Inf": number("inf", "{:,.0f}"),
    "compared with": text("{compared}"),
    "": lambda row: "green" if row["green"] else "RED",
}
SUMMARY: Columns = {
    "area": text("{area}"),
    "cases": number("cases", "{:,.0f}"),
    "red": number("red", "{:,.0f}"),
    "error / tolerance, at most": number("share", "{:.2g}"),
    "NaN": number("nan", "{:,.0f}"),
    "Inf": number("inf", "{:,.0f}"),
    "": lambda row: "RED" if row["red"] else "green",
}


def measure(options: DictConfig, console: Console) -> Result:
    """Measure every case of the areas `options.stability.areas`, on the CPU.

    Returns:
        "rows": see `comparison.make_row`, and "area", "case" and "precision".

    Raises:
        InputError: an unknown area or model, a number below 1.
    """
    options = options.stability
    check_names("stability.areas", options.areas, AREAS)
    check_overrides([f"model={model}" for model in options.models])
    for name in ("views", "training_steps", "refinement_steps"):
        values = options[name] if name == "views" else [options[name]]
        if not all(isinstance(value, int) and value >= 1 for value in values):
            setting = f"stability.{name}={options[name]}"
            raise InputError(f"{setting} cannot be: give whole numbers from 1.")
    cases = [(area, case) for area in options.areas for case in AREAS[area](options)]
    cases = track(cases, "cases", console=console)
    return {"rows": [{"area": area, **case.row()} for area, case in cases]}


def verdict(results: Result) -> str | None:
    """Return a sentence if any case is red, else None."""
    rows = results["rows"]
    red = [f"{r['area']}: {r['case']} ({r['precision']})" for r in rows if not r["green"]]
    if not red:
        return None
    named = "; ".join(red[:3] + ["..."] * (len(red) > 3))
    return f"red: {len(red)} of {len(rows)} cases are not stable: {named}"


def summary(rows: Sequence[Result]) -> list[Result]:
    """Sum up each area.

    Returns:
        "area", "cases", "red", "nan", "inf" and "share": the largest error over its tolerance, None
        without errors.
    """
    areas = []
    for area in dict.fromkeys(row["area"] for row in rows):
        cases = [row for row in rows if row["area"] == area]
        ratios = (row["error"] / row["tolerance"] for row in cases if row["error"])
        areas.append(
            {"area": area, "cases": len(cases), "red": sum(not row["green"] for row in cases)}
            | {name: sum(row[name] for row in cases) for name in ("nan", "inf")}
            | {"share": max(ratios, default=None)}
        )
    return areas


def tables(results: Result) -> list[Table]:
    """Make a table of the areas, and a table of all cases of each area."""
    rows, areas = results["rows"], summary(results["rows"])
    red, count = sum(area["red"] for area in areas), len(rows)
    state = f"{red} of {count} cases are RED" if red else f"all {count} cases are green"
    machine = ", ".join(f"{key} {value}" for key, value in results["machine"].items())
    notes = f"{state}\nrevision {results.get('revision')}; {machine}\n{RULE}"
    shown = [make_table("Stability", SUMMARY, areas, notes)]
    for area in [row["area"] for row in areas]:
        cases = [row for row in rows if row["area"] == area]
        shown.append(make_table(area.capitalize(), COLUMNS, cases, names=3))
    return shown


def plot(results: Result) -> Figure:
    """Plot each area's largest error over its tolerance."""
    areas = summary(results["rows"])
    names = [f"{row['area']}: {row['cases'] - row['red']} of {row['cases']} green" for row in areas]
    errors = {"largest error": [row["share"] or 0.0 for row in areas]}
    return bars(names, errors, "error / tolerance", tolerance=1.0)
