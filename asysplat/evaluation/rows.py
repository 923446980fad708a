"""Numbers of images: a row for each, their means, and a table as a file."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch

from asysplat.files import atomic_write

ImageRow = dict[str, str | float]
# What a row is of: its other columns are numbers that have a mean.
LABELS = ("set", "scene", "images", "view", "source")


def average(rows: Sequence[ImageRow], over: Literal["images", "scenes"]) -> dict[str, float]:
    """Average every numeric column over the images that have it; NaN is left out.

    Args:
        rows: of one test set.
        over: "images": all alike, or "scenes": each scene's images first, then the scenes.
    """
    if over == "scenes":
        scenes: dict[str | float, list[ImageRow]] = {}
        for row in rows:
            scenes.setdefault(row["scene"], []).append(row)
        rows = [average(images, "images") for images in scenes.values()]
    columns: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            if name not in LABELS:
                columns.setdefault(name, []).append(value)
    return {name: torch.tensor(values).nanmean().item() for name, values in columns.items()}


def write_csv(path: Path, rows: Sequence[ImageRow]) -> None:
    """Write a line for each row; what a row lacks, as depths of a scene without, is left empty.

    The file appears complete or not at all.
    """
    with atomic_write(path) as partial, partial.open("w", newline="") as file:
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows(rows)
