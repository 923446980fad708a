"""What a forward pass goes into, for each view, and its floor."""

from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from asysplat.benchmark.model.components import COMPONENTS, OTHERS
from asysplat.report.svg import INK, STYLE

COLOURS = dict(zip((*COMPONENTS, OTHERS), matplotlib.colormaps["tab10"].colors, strict=False))

Result = Mapping[str, Any]


def plot(results: Result) -> Figure:
    """A bar for each network, precision and number of views."""
    rows = results["rows"]
    names = [f"{row['model']}, {row['views']} views, {row['precision']}" for row in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 1.6 + 0.5 * len(rows)), layout="constrained")
        axes = figure.subplots()
        starts = [0.0] * len(rows)
        for component, colour in COLOURS.items():
            widths = [_per_view(row, row["components"].get(component)) for row in rows]
            if any(widths):
                axes.barh(names, widths, left=starts, color=colour, label=component)
            starts = [start + width for start, width in zip(starts, widths, strict=True)]
        floors = [1000 * row["floor"]["median"] / row["views"] for row in rows]
        axes.plot(floors, names, "|", color=INK, ms=18, mew=2, label="floor")
        axes.set_xlabel("milliseconds of a forward pass for each view")
        axes.invert_yaxis()
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def _per_view(row: Result, component: Result | None) -> float:
    return 1000 * component["seconds"]["median"] / row["views"] if component else 0.0
