"""Write a suite's numbers, tables and figure."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table

from asysplat.benchmark.table import markdown
from asysplat.benchmark.timing import Result
from asysplat.files import atomic_write

WIDTH = 100  # characters of a line, above which a dictionary of dictionaries or lists is split


def dumps(value: Any, indent: str = "") -> str:
    """Write JSON with each row of a list, and each dictionary of plain values, on one line.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    line = json.dumps(value, allow_nan=False)
    items = value.values() if isinstance(value, dict) else value
    if len(line) <= WIDTH or not any(isinstance(item, dict | list) for item in items):
        return line
    if isinstance(value, list):
        rows = [f"{indent} {json.dumps(row)}" for row in value]
        return "\n".join(["[", ",\n".join(rows), f"{indent}]"])
    rows = [f"{indent} {json.dumps(k)}: {dumps(v, indent + ' ')}" for k, v in value.items()]
    return "\n".join(["{", ",\n".join(rows), f"{indent}}}"])


def write_results(
    results: Result, tables: Sequence[Table], figure: Figure | None, path: Path
) -> list[Path]:
    """Write <path>.json, <path>.md and, of a figure, <path>.png; return their paths.

    Raises:
        InputError: a file cannot be written.
        ValueError: a result is NaN or infinite.
    """
    texts = {".json": dumps(results) + "\n", ".md": "\n".join(map(markdown, tables))}
    path.parent.mkdir(parents=True, exist_ok=True)
    for suffix, content in texts.items():
        with atomic_write(path.with_suffix(suffix)) as partial:
            partial.write_text(content)
    if figure is not None:
        with atomic_write(path.with_suffix(".png")) as partial:
            figure.savefig(partial, dpi=150)
    return [path.with_suffix(s) for s in (*texts, ".png") if s in texts or figure is not None]
