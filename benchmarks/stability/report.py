"""The suite: measure every case, and show which ones are red."""

from collections.abc import Callable, Iterable, Sequence

from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from benchmarks.compare import ERROR, TrackedMetrics
from benchmarks.options import check_names
from benchmarks.plot import bars
from benchmarks.stability.comparison import RULE, StabilityCase
from benchmarks.stability.models import depth_cases, network_cases
from benchmarks.stability.operators import operator_cases
from benchmarks.stability.optimization import refinement_cases, training_cases
from benchmarks.stability.renderer import renderer_cases
from benchmarks.table import (
    NOT_MEASURED,
    Columns,
    machine_text,
    make_table,
    number_column,
    text_column,
)
from benchmarks.timing import Result

AREAS: dict[str, Callable[[DictConfig], Iterable[StabilityCase]]] = {
    "operators": lambda options: [*operator_cases(), *depth_cases(plane_sweep=True)],
    "prior": lambda options: depth_cases(False, options.views),
    "renderer": lambda options: renderer_cases(options.views),
    "network": lambda options: network_cases(options.models, options.overrides, options.views),
    "training": lambda options: training_cases(options.models, options.training_steps),
    "refinement": lambda options: refinement_cases(options.refinement_steps),
}
TRACKED = TrackedMetrics(names=("area", "case", "precision"), must_match=(), kinds={"error": ERROR})
COLUMNS: Columns = {
    "case": text_column("{case}"),
    "precision": text_column("{precision}"),
    "worst": lambda row: row["worst"] or NOT_MEASURED,
    "error": number_column("error", "{:.1e}"),
    "tolerance": number_column("tolerance", "{:.1e}"),
    "NaN": number_column("nan", "{:,.0f}"),
    "Inf": number_column("inf", "{:,.0f}"),
    "compared with": text_column("{compared}"),
    "": lambda row: "green" if row["green"] else "RED",
}
SUMMARY: Columns = {
    "area": text_column("{area}"),
    "cases": number_column("cases", "{:,.0f}"),
    "red": number_column("red", "{:,.0f}"),
    "error / tolerance, at most": number_column("share", "{:.2g}"),
    "NaN": number_column("nan", "{:,.0f}"),
    "Inf": number_column("inf", "{:,.0f}"),
    "": lambda row: "RED" if row["red"] else "green",
}


def measure(options: DictConfig, console: Console) -> Result:
    """Measure every case of the areas in `options.stability.areas` on the CPU.

    Returns:
        "rows": one for each case, with "area", "case", "precision" and the values of
        `comparison.make_row`.
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
    """Return a message that names the red cases; None if there are none."""
    rows = results["rows"]
    red = [f"{r['area']}: {r['case']} ({r['precision']})" for r in rows if not r["green"]]
    if not red:
        return None
    named = "; ".join(red[:3] + ["..."] * (len(red) > 3))
    return f"red: {len(red)} of {len(rows)} cases are not stable: {named}"


def summarize_areas(rows: Sequence[Result]) -> list[Result]:
    """Summarize each area.

    Returns:
        Rows with "area"; "cases" and "red", numbers of cases; "nan" and "inf", counts in all
        results; "share", the largest ratio of error to tolerance, None without errors.
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
    rows, areas = results["rows"], summarize_areas(results["rows"])
    red, count = sum(area["red"] for area in areas), len(rows)
    state = f"{red} of {count} cases are RED" if red else f"all {count} cases are green"
    notes = f"{state}\nrevision {results.get('revision')}; {machine_text(results)}\n{RULE}"
    shown = [make_table("Stability", SUMMARY, areas, notes)]
    for area in [row["area"] for row in areas]:
        cases = [row for row in rows if row["area"] == area]
        shown.append(make_table(area.capitalize(), COLUMNS, cases, names=3))
    return shown


def plot(results: Result) -> Figure:
    """Plot each area's largest error over its tolerance."""
    areas = summarize_areas(results["rows"])
    names = [f"{row['area']}: {row['cases'] - row['red']} of {row['cases']} green" for row in areas]
    errors = {"largest error": [row["share"] or 0.0 for row in areas]}
    return bars(names, errors, "error / tolerance", tolerance=1.0)
