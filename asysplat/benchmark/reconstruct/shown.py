"""The tables and the picture of refinements."""

from matplotlib.figure import Figure
from rich.table import Table

from asysplat.benchmark.plot import against_seconds
from asysplat.benchmark.reconstruct.scene import FOR_NOTHING, NEAREST
from asysplat.benchmark.table import NOTHING, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import Result

ALL, START = "all", "start"  # all parts of the refinement, and 0 seconds of it
METRICS = {  # headings, and how numbers are written
    "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "absrel": ("AbsRel", "{:.3f}"),
    "delta1": ("delta < 1.25", "{:.3f}"),
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
        "step, ms": spread("step"),
        "renderer, ms": spread("renderer"),
        "step\n/ renderer": number("over_renderer", "{:.2f}"),
    }
    views = ", ".join(
        f"{n} {v['inputs']} and {v['measured']}" for n, v in results["scenes"].items()
    )
    notes = (
        f"{'x'.join(map(str, results['size']))}; views fitted to, and held back: {views}\n"
        "each row is one run of so many seconds; all: with all parts of the refinement"
    )
    if not results["complete"]:
        notes += "\nthe suite was stopped before its end"
    cost_notes = (
        f"{measured_on(results)}\n"
        "step, renderer: the last Gaussians and one photograph, in turns; ms / step: the whole run"
    )
    refined = [row for row in rows if row["variant"] not in FOR_NOTHING]
    found = [
        make_table("Photographs held back", names | metrics, rows, notes, names=3),
        make_table("What it took", names | costs, refined, cost_notes, names=3),
    ]
    parts = compare_parts(results)
    if parts:
        more = {
            f"{heading}\nover all": number(f"more.{name}", pattern.replace(":", ":+"))
            for name, (heading, pattern) in shown.items()
        }
        columns = {"refinement": text("{variant}"), "scenes": text("{scenes}")} | metrics | more
        title = f"Parts of the refinement, {results['budget']:g} s, means over scenes"
        found.append(make_table(title, columns, parts))
    return found


def compare_parts(results: Result) -> list[Result]:
    """Compare ALL and each variant: their means over scenes, and how much more than ALL's they are.

    All have the variants' budget and start.
    """
    runs: dict[str, dict[str, Result]] = {name: {} for name in (ALL, *results["variants"])}
    for row in results["rows"]:
        alike = (row.get("init"), row.get("budget")) == (results["inits"][0], results["budget"])
        if alike and row["variant"] in runs:
            runs[row["variant"]][row["scene"]] = row
    compared = []
    for name, found in runs.items():
        if not found:
            continue
        pairs = [(row, runs[ALL][scene]) for scene, row in found.items()]
        row = {"variant": name, "scenes": len(pairs), "more": {}}
        for metric in METRICS:
            both = [
                (one[metric], other[metric])
                for one, other in pairs
                if one.get(metric) is not None and other.get(metric) is not None
            ]
            if both:
                row[metric] = sum(one for one, _ in both) / len(both)
                row["more"][metric] = sum(one - other for one, other in both) / len(both)
        compared.append(row)
    return compared


def plot(results: Result) -> Figure:
    """Plot PSNR and LPIPS of each scene against the seconds of refinement."""
    rows = results["rows"]
    metrics = {"psnr": "PSNR, dB", "lpips": "LPIPS"}
    panels: dict[str, dict[str, list[Result]]] = {scene: {} for scene in results["scenes"]}
    for row in rows:
        name = f"from {row['init']}" if row["variant"] in (ALL, START) else row["variant"]
        if name not in FOR_NOTHING or name == NEAREST:
            panels[row["scene"]].setdefault(name, []).append(row)
    names = dict.fromkeys(name for panel in panels.values() for name in panel)
    shown = {name: label for name, label in metrics.items() if _any(rows, name)}
    return against_seconds(panels, shown, list(names))


def _any(rows: list[Result], name: str) -> bool:
    return any(row.get(name) is not None for row in rows)
