"""Rows of metrics, one for each image: averages and CSV files."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch

from asysplat.files import atomic_write

ImageRow = dict[str, str | float | int]
# Columns that name the image of a row; the others are numbers.
LABELS = ("set", "scene", "images", "view", "method")


def average(rows: Sequence[ImageRow], over: Literal["images", "scenes"]) -> dict[str, float]:
    """Average every numeric column over the images that have it; NaN is left out.

    Args:
        rows: images of one test set.
        over: "images": all at once, or "scenes": the images of each scene first, then the scenes.
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
    """Write a CSV file atomically; columns that a row lacks are left empty."""
    with atomic_write(path) as partial, partial.open("w", newline="") as file:
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows(rows)
