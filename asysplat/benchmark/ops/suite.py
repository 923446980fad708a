"""Every path of the operators: time beside the sequential loop and bare matmuls; error; memory."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.benchmark.compare import ERROR, TIME, Watched
from asysplat.benchmark.ops.cases import SCANS, Case, find_cases
from asysplat.benchmark.ops.paths import make_path
from asysplat.benchmark.ops.sweep import SweepCase
from asysplat.benchmark.options import PRECISIONS, check_names, find_device
from asysplat.benchmark.plot import time_against_error
from asysplat.benchmark.products import products, time_products, with_gradients
from asysplat.benchmark.table import (
    Write,
    error,
    limited,
    make_table,
    measured_on,
    number,
    spread,
    text,
)
from asysplat.benchmark.timing import Measurement, Result, Timer, ratios, time_in_rounds
from asysplat.errors import InputError

PASSES = {"forward": "Forward", "forward_backward": "Forward and backward"}
ERRORS = {"forward": "error.forward", "forward_backward": "error.gradients"}
WATCHED = Watched(
    names=("operator", "precision", "path"),
    alike=("sizes", "loop_tokens", "error.measured_on"),
    kinds=dict.fromkeys(PASSES, TIME) | dict.fromkeys(ERRORS.values(), ERROR),
)
LOOP, REFERENCE, MATMULS = "loop", "reference", "matmuls"
MOST_OVER_MATMULS = 2.5  # is asked of ssd


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, times in seconds. The path "loop" is the
        reference in fp32 on a shorter sequence, its times scaled to the whole; "matmuls" are the
        operator's matrix products by themselves. plane_sweep, which has neither and no gradients,
        has its reference on all pixels, and products with as many multiplications.

    Raises:
        InputError: an unknown precision or device, sizes an operator cannot take.
    """
    device = find_device(options.device)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    check_names("ops.precisions", sizes["precisions"], PRECISIONS)
    results: list[Result] = []
    sweep = SweepCase("plane_sweep", sizes["plane_sweep"], sizes["exact"]["plane_sweep"])
    for case in track([*find_cases(sizes), sweep], "operators", console=console):
        rows = make_rows(case, sizes["precisions"], sizes["loop_tokens"], device)
        time_in_rounds(rows, options.repeats)
        found = [row.found | _summaries(row) for row in rows]
        paths = {(result["path"], result["precision"]): result for result in found}
        loop = paths.get((LOOP, "fp32")) or paths.get((REFERENCE, "fp32"))
        for result in found:
            matmuls = paths.get((MATMULS, result["precision"]))
            result["faster_than_loop"] = loop and ratios(loop, result, PASSES)
            result["over_matmuls"] = matmuls and ratios(result, matmuls, PASSES)
        results += found
    return {"rows": results}


def _summaries(row: Measurement) -> Result:
    """Return those of both passes, None for one that there is not."""
    return {name: row.summary(name) if name in row.seconds else None for name in PASSES}


def make_rows(
    case: Case, precisions: Iterable[str], loop_tokens: int, device: torch.device
) -> list[Measurement]:
    """Prepare the measurements of one operator: its paths, its bare products, the loop.

    Args:
        precisions: of the inputs.
        loop_tokens: length of the sequence that the loop is timed on.
    """
    rows = []
    for precision in [name for name in precisions if name in case.precisions]:
        dtype = PRECISIONS[precision]
        exact = make_path(case.small, "reference", dtype, device).truth()
        for backend in case.backends:
            if backend in {"cpu", "cuda"} - {device.type}:
                continue
            try:
                errors = make_path(case.small, backend, dtype, device).errors(exact)
            except InputError:  # the operator has no such backend, or it cannot run here
                continue
            path = make_path(case, backend, dtype, device)
            found = {"error": errors, "bytes_per_token": path.bytes_per_token()}
            rows.append(_row(case, precision, backend, path.seconds, **found))
        if case.products():
            sizes = {"forward": case.products()}
            if case.differentiable:
                sizes["forward_backward"] = with_gradients(case.products())
            groups = {name: products(size, dtype, device) for name, size in sizes.items()}
            rows.append(_row(case, precision, MATMULS, partial(time_products, groups, device)))
    return [*rows, _loop(case, loop_tokens, device)] if case.operator in SCANS else rows


def _loop(case: Case, tokens: int, device: torch.device) -> Measurement:
    """Prepare the reference in fp32, which takes one token after the other."""
    small = make_path(case.small, "reference", torch.float32, device)
    length = min(tokens, case.sizes["length"])
    path = make_path(case.resized(length=length), "reference", torch.float32, device)
    scale = case.sizes["length"] / length
    return _row(
        case,
        "fp32",
        LOOP,
        lambda: {name: scale * value for name, value in path.seconds().items()},
        error=small.errors(small.truth()),
        bytes_per_token=path.bytes_per_token(),
        loop_tokens=length,
    )


def _row(case: Case, precision: str, path: str, timer: Timer, **found: Any) -> Measurement:
    what = {"operator": case.name, "sizes": dict(case.sizes), "precision": precision, "path": path}
    what |= {"threads": torch.get_num_threads(), "error": None, "bytes_per_token": None}
    return Measurement(timer, what | found)


def tables(results: Result) -> list[Table]:
    """Show each pass: its time, against the sequential loop and bare matmuls; error; memory."""
    rows = results["rows"]
    loop = max((row["loop_tokens"] for row in rows if row["path"] == LOOP), default=0)
    notes = (
        f"{measured_on(results)}\n"
        f"loop: reference.py in fp32 on {loop} tokens, times scaled to the whole sequence; of "
        "plane_sweep the reference\n"
        "matmuls: the operator's matrix products by themselves; of plane_sweep as many "
        "multiplications\n"
        "error: against the reference in float64, relative in L2; *: of a smaller one of its kind"
    )

    def columns(name: str) -> dict[str, Callable]:
        return {
            "operator": text("{operator}"),
            "inputs": text("{precision}"),
            "path": text("{path}"),
            "ms": spread(name),
            "loop\n/ path": number(f"faster_than_loop.{name}", "{:.1f}"),
            "path\n/ matmuls": _over_matmuls(f"over_matmuls.{name}"),
            "error": error(ERRORS[name]),
            "kB\n/ token": number(f"bytes_per_token.{name}", "{:.2f}", unit=1e3),
        }

    return [
        make_table(title, columns(name), [row for row in rows if row[name]], notes, 3)
        for name, title in PASSES.items()
    ]


def _over_matmuls(path: str) -> Write:
    """Write the ratio, in red where ssd is above its limit."""
    asked, others = limited(path, MOST_OVER_MATMULS), number(path, "{:.2f}")
    return lambda row: (asked if row["operator"] == "ssd" else others)(row)


def plot(results: Result) -> Figure:
    """Plot the forward pass, and both passes."""
    exact = "against float64, relative L2"
    labels = {"forward": f"output {exact}", "forward_backward": f"worst gradient {exact}"}
    errors = {name: (label, ERRORS[name]) for name, label in labels.items()}
    rows = [row for row in results["rows"] if row["error"]]
    return time_against_error(rows, errors, backend="path", case="operator")
