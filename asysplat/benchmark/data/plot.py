"""Frames a second: what loading gives, and what the network takes."""

from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from asysplat.report.svg import INK, OURS, STYLE


def plot(results: Mapping[str, Any]) -> Figure:
    rows = results["loading"]
    rates = [row["frames_per_second"] for row in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6, 2.4), layout="constrained")
        axes = figure.subplots()
        axes.barh(
            [row["cache"] for row in rows],
            [rate["median"] for rate in rates],
            xerr=[rate["iqr"] / 2 for rate in rates],
            color=OURS,
        )
        axes.axvline(results["network"]["median"], color=INK, ls="--", label="the network takes")
        axes.set(xlabel="frames a second", ylabel="cache on disk")
        axes.legend(frameon=False)
    return figure
