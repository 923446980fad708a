"""The means over scenes, the tables and the picture of all knobs."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from rich.table import Table

from asysplat.benchmark.pareto.settings import BASE
from asysplat.benchmark.table import Columns, at, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import Result
from asysplat.report.front import draw_front, pareto_front
from asysplat.report.style import FAINT, OURS, STYLE

TITLES = {
    "feed_forward": "Feed-forward",
    "networks": "Other layers, untrained",
    "refined": "Refined",
}
QUALITIES = {  # higher is better
    "psnr": "PSNR against photographs, dB",
    "error_decibels": "PSNR against the exact pictures, dB",
}
NOTES = """\
-: not measured; photographs in memory to all test views; / base: in the same round, in turns
error: of pictures in [0, 1] against the base in float64, of other layers against their own, of \
refinements against the base"""


def summarize(rows: Sequence[Result]) -> list[Result]:
    """Average each setting of each family over its scenes.

    Returns:
        "scenes" counts those that it was measured on; "seconds", "psnr", "lpips" and
        "error_decibels" are means; "over_base" is a geometric one; "lost" is the PSNR below the
        base's, "most_lost" that of the worst scene; "error_max" and "peak_gb" are the largest;
        "busy" says whether a measurement was; "on_front" whether no other setting of the family
        has both less seconds and a higher PSNR (a lower error, where there is no PSNR). None for
        what was measured on no scene.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for row in rows:
        groups.setdefault((row["family"], row["setting"]), []).append(row)
    bases = {(row["family"], row["scene"]): row for row in rows if row["setting"] == BASE}
    found = [
        {"family": family, "setting": name, **_means(group, bases)}
        for (family, name), group in groups.items()
    ]
    for family in dict.fromkeys(row["family"] for row in found):
        own = [row for row in found if row["family"] == family]
        quality = next((name for name in QUALITIES if points(own, name)), None)
        front = [name for name, *_ in pareto_front(points(own, quality), "higher")]
        for row in own:
            row["on_front"] = row["setting"] in front
    return found


def _means(group: Sequence[Result], bases: Mapping[tuple[str, str], Result]) -> Result:
    measured = [row for row in group if row["seconds"]]

    def values(path: str) -> list[float]:
        return [value for row in measured if (value := at(row, path)) is not None]

    lost = [
        bases[row["family"], row["scene"]]["psnr"] - row["psnr"]
        for row in measured
        if row["psnr"] is not None
    ]
    ratios = values("over_base.median")
    return {
        "scenes": len(measured),
        "seconds": _mean(values("seconds.median")),
        "over_base": math.exp(fmean(map(math.log, ratios))) if ratios else None,
        "psnr": _mean(values("psnr")),
        "lost": _mean(lost),
        "most_lost": max(lost, default=None),
        "lpips": _mean(values("lpips")),
        "error_decibels": _mean(values("error.decibels")),
        "error_max": max(values("error.max"), default=None),
        "peak_gb": max(values("peak_gb"), default=None),
        "busy": any(row["seconds"]["busy"] for row in measured),
    }


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def points(rows: Sequence[Result], quality: str | None) -> list[tuple[str, float, float]]:
    """Return name, seconds and quality of the settings that have both."""
    return [
        (row["setting"], row["seconds"], row[quality])
        for row in rows
        if quality and row["seconds"] is not None and row[quality] is not None
    ]


def tables(results: Result) -> list[Table]:
    """Show each scene's settings, then the means over scenes of each family."""
    absent = "\n".join(f"not measured: {k}, {why}" for k, why in results["not_measured"].items())
    notes = "\n".join(filter(None, (measured_on(results), NOTES, absent)))
    shown = [
        make_table(f"{TITLES[family]}, {scene}", ROWS, rows)
        for (family, scene), rows in _grouped(results["rows"], ("family", "scene")).items()
    ]
    families = _grouped(results["settings"], ("family",))
    return shown + [
        make_table(f"{TITLES[family]}, means over scenes", MEANS, rows, notes)
        for (family,), rows in families.items()
    ]


def _grouped(rows: Sequence[Result], names: Sequence[str]) -> dict[tuple[str, ...], list[Result]]:
    groups: dict[tuple[str, ...], list[Result]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def plot(results: Result) -> Figure:
    """Plot each quality against seconds: a column for each family, the front drawn."""
    families = _grouped(results["settings"], ("family",))
    shown = [name for name in QUALITIES if points(results["settings"], name)]
    with matplotlib.rc_context(STYLE):
        size = (1.0 + 5.2 * len(families), 0.8 + 4.2 * len(shown))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(shown), len(families), squeeze=False)
        for column, (family,) in enumerate(families):
            for axes, quality in zip(grid[:, column], shown, strict=True):
                axes.set(title=TITLES[family], xlabel="seconds", ylabel=QUALITIES[quality])
        for column, rows in enumerate(families.values()):
            busy = [row["setting"] for row in rows if row["busy"]]
            for axes, quality in zip(grid[:, column], shown, strict=True):
                _draw(axes, points(rows, quality), busy)
        note = "hollow: measured while the machine was busy; crowded names are left out"
        figure.supxlabel(note, fontsize=9, color=FAINT)
    return figure


def _draw(axes: Axes, found: Sequence[tuple[str, float, float]], busy: Sequence[str]) -> None:
    if not found:
        axes.text(0.5, 0.5, "not measured", color=FAINT, ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    draw_front(axes, found, "higher", OURS, busy)


ROWS: Columns = {
    "setting": text("{setting}"),
    "ms": spread("seconds"),
    "/ base": spread("over_base", "{:.2f}", unit=1.0),
    "PSNR": number("psnr", "{:.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "error\ndB": number("error.decibels", "{:.1f}"),
    "error\nmax": number("error.max", "{:.1e}"),
    "MB": number("peak_gb", "{:.0f}", unit=1e-3),
}
MEANS: Columns = {
    "setting": text("{setting}"),
    "front": lambda row: "*" if row["on_front"] else "",
    "scenes": text("{scenes}"),
    "ms": number("seconds", "{:.0f}", unit=1e-3),
    "": lambda row: "busy" if row["busy"] else "",
    "/ base": number("over_base", "{:.2f}"),
    "PSNR": number("psnr", "{:.2f}"),
    "PSNR\nlost": number("lost", "{:+.2f}"),
    "at\nmost": number("most_lost", "{:+.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "error\ndB": number("error_decibels", "{:.1f}"),
    "error\nmax": number("error_max", "{:.1e}"),
    "MB": number("peak_gb", "{:.0f}", unit=1e-3),
}
