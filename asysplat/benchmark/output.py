"""Write a suite's numbers, tables and figure, and the same for TensorBoard."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table
from torch.utils.tensorboard import SummaryWriter

from asysplat.benchmark.compare import Watched, watched_values
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
    results: Result, tables: Sequence[Table], figure: Figure, watched: Watched, path: Path
) -> list[Path]:
    """Write <path>.json, <path>.md, <path>.png and a folder for TensorBoard; return their paths.

    TensorBoard shows every revision of the code as a run of its own.

    Raises:
        InputError: a file cannot be written.
        ValueError: a result is NaN or infinite.
    """
    numbers, text, image = (path.with_suffix(end) for end in (".json", ".md", ".png"))
    content = dumps(results) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(numbers) as partial:
        partial.write_text(content)
    with atomic_write(text) as partial:
        partial.write_text("\n".join(map(markdown, tables)))
    with atomic_write(image) as partial:
        figure.savefig(partial, dpi=150)
    board = path.parent / "tensorboard" / path.name / results["revision"]
    with SummaryWriter(board, purge_step=0) as writer:
        writer.add_figure(path.name, figure, close=False)
        for key, value in watched_values(results, watched).items():
            writer.add_scalar(f"{path.name}/{key.name}/{key.path}", value.median, 0)
    return [numbers, text, image, board]
