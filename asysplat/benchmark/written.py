"""What a suite leaves: numbers, tables, a picture, and the same for TensorBoard."""

import json
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table
from torch.utils.tensorboard import SummaryWriter

from asysplat.benchmark.compare import Watched, watched_values
from asysplat.benchmark.table import markdown
from asysplat.benchmark.timing import Result
from asysplat.files import atomic_write


def write_results(
    results: Result, tables: Sequence[Table], figure: Figure, watched: Watched, path: Path
) -> list[Path]:
    """Write <path>.json, <path>.md, <path>.png and a folder for TensorBoard; return their paths.

    TensorBoard shows every revision of the code as a run of its own, beside the others.

    Raises:
        InputError: a file cannot be written.
        ValueError: a result is NaN or infinite.
    """
    numbers, text, picture = (path.with_suffix(end) for end in (".json", ".md", ".png"))
    written = json.dumps(results, indent=2, allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(numbers) as partial:
        partial.write_text(written)
    with atomic_write(text) as partial:
        partial.write_text("\n".join(map(markdown, tables)))
    with atomic_write(picture) as partial:
        figure.savefig(partial, dpi=150)
    board = path.parent / "tensorboard" / path.name / results["revision"]
    with SummaryWriter(board, purge_step=0) as writer:
        writer.add_figure(path.name, figure, close=False)
        for key, value in watched_values(results, watched).items():
            writer.add_scalar(f"{path.name}/{key.name}/{key.path}", value.median, 0)
    return [numbers, text, picture, board]
