"""The measurement on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from asysplat.benchmark.table import describe_machine_in_words, make_table, milliseconds

Result = Mapping[str, Any]


def tables(results: Result) -> list[Table]:
    """How soon a scene opens, and how fast its frames come."""
    scene, network = results["scene"], results["network"]
    opened = {
        "frames": lambda row: str(row["frames"]),
        "ms, no pixel read": lambda row: milliseconds(results["open"]),
        "ms / frame": lambda row: f"{1000 * results['open']['median'] / row['frames']:.2f}",
    }
    loaded = {
        "cache on disk": lambda row: row["cache"],
        "frames / s": lambda row: in_words(row["frames_per_second"]),
        "loading\n/ network": lambda row: f"{row['over_network']:.1f}",
    }
    photographs, views = ("x".join(map(str, scene[name])) for name in ("photographs", "views"))
    notes = (
        f"{describe_machine_in_words(results['machine'])}\nmedian ± interquartile range\n"
        f"photographs of {photographs} for views of {views}, by {scene['workers']} workers\n"
        f"the network alone takes {in_words(network)} frames / s in training"
    )
    return [
        make_table("Opening a scene", opened, [scene]),
        make_table("Loading training tasks", loaded, results["loading"], notes),
    ]


def in_words(rate: Mapping[str, float]) -> str:
    return f"{rate['median']:.0f} ± {rate['iqr']:.0f}"
