"""The tables and the picture of refinements."""

from collections.abc import Mapping

from matplotlib.figure import Figure
from rich.table import Table

from asysplat.benchmark.plot import against_seconds
from asysplat.benchmark.reconstruct.scene import FOR_NOTHING, NEAREST
from asysplat.benchmark.table import NOTHING, Write, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import Result

ALL, START = "all", "start"  # all parts of the refinement, and 0 seconds of it
METRICS = {  # headings, and how numbers are written
    "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "absrel": ("AbsRel", "{:.3f}"),
    "delta1": ("delta\n< 1.25", "{:.3f}"),
}


def tables(results: Result) -> list[Table]:
    """Show how good each row is, what it took, and what each part of the refinement gives."""
    rows = results["rows"]
    names = {
        "scene": text("{scene}"),
        "start": lambda row: row.get("init", NOTHING),
        "refinement": text("{variant}"),
        "s": number("budget", "{:g}"),
    }
    shown = {name: METRICS[name] for name in METRICS if _any(rows, name)}
    metrics = {heading: number(name, pattern) for name, (heading, pattern) in shown.items()}
    costs = {
        "Gaussians": number("gaussians", "{:,.0f}"),
        "start, s": number("start", "{:.1f}"),
        "steps": number("steps", "{:,.0f}"),
        "ms / step": number("seconds_a_step", "{:.0f}", unit=1e-3),
        "renderer, ms": spread("renderer"),
        "step\n/ renderer": number("over_renderer", "{:.2f}"),
    }
    if "goal" in results:  # not in older ones
        costs[f"s to\n{results['goal']:g} dB"] = number("to_goal", "{:.1f}")
    views = ", ".join(
        f"{n} {v['inputs']} and {v['measured']}" for n, v in results["scenes"].items()
    )
    notes = (
        f"{'x'.join(map(str, results['size']))}; views fitted to, and held out: {views}\n"
        "each row is one run of so many seconds; all: with all parts of the refinement"
    )
    if not results["complete"]:
        notes += "\nthe suite was stopped before its end"
    cost_notes = (
        f"{measured_on(results)}\n"
        "ms / step: of the whole run; the others: the last Gaussians, one photograph, in turns"
    )
    refined = [row for row in rows if row["variant"] not in FOR_NOTHING]
    found = [
        make_table("Photographs held out", names | metrics, rows, notes, names=3),
        make_table("What it took", names | costs, refined, cost_notes, names=3),
    ]
    written = {heading: _more(name, pattern) for name, (heading, pattern) in shown.items()}
    columns = {"refinement": text("{variant}"), "scenes": text("{scenes}")} | written
    title = f"Parts of the refinement: {ALL}, and how much more the others have"
    part_notes = f"means over scenes, after {results['budget']:g} s from {results['inits'][0]}"
    return [*found, make_table(title, columns, compare_parts(results), part_notes)]


def compare_parts(results: Result) -> list[Result]:
    """Average the metrics of ALL over scenes, and those of each variant less those of ALL.

    All have the variants' budget and first start.
    """
    runs: dict[str, dict[str, Result]] = {name: {} for name in (ALL, *results["variants"])}
    for row in results["rows"]:
        alike = (row.get("init"), row.get("budget")) == (results["inits"][0], results["budget"])
        if alike and row["variant"] in runs:
            runs[row["variant"]][row["scene"]] = row
    return [
        {"variant": name, "scenes": len(found)}
        | {metric: _mean_more(name, found, runs[ALL], metric) for metric in METRICS}
        for name, found in runs.items()
    ]


def _mean_more(
    name: str, found: Mapping[str, Result], whole: Mapping[str, Result], metric: str
) -> float | None:
    pairs = [(row.get(metric), whole[scene].get(metric)) for scene, row in found.items()]
    values = [
        value if name == ALL else value - of_all
        for value, of_all in pairs
        if None not in (value, of_all)
    ]
    return sum(values) / len(values) if values else None


def _more(metric: str, pattern: str) -> Write:
    """Write a metric of ALL, and with its sign what others have more."""
    signed = number(metric, pattern.replace(":", ":+"))
    return lambda row: (number(metric, pattern) if row["variant"] == ALL else signed)(row)


def plot(results: Result) -> Figure:
    """Plot PSNR and LPIPS of each scene against the seconds of refinement."""
    rows = results["rows"]
    own = (ALL, START, NEAREST)  # before the variants, in the legend
    panels: dict[str, dict[str, list[Result]]] = {scene: {} for scene in results["scenes"]}
    for row in sorted(rows, key=lambda row: row["variant"] not in own):
        name = f"from {row['init']}" if row["variant"] in (ALL, START) else row["variant"]
        if name in (NEAREST, *results["variants"]) or row["variant"] in own:
            panels[row["scene"]].setdefault(name, []).append(row)
    metrics = {"psnr": "PSNR, dB", "lpips": "LPIPS"}
    shown = {name: label for name, label in metrics.items() if _any(rows, name)}
    return against_seconds(panels, shown)


def _any(rows: list[Result], name: str) -> bool:
    return any(row.get(name) is not None for row in rows)
