"""Every path of the operators: time beside the sequential loop and bare matmuls; error; memory."""

from collections.abc import Callable, Mapping, Sequence

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.benchmark.ops.cases import SCANS, Case, find_cases
from asysplat.benchmark.ops.paths import Path
from asysplat.benchmark.options import find_device, find_precisions
from asysplat.benchmark.plot import time_against_error
from asysplat.benchmark.products import product_seconds, products, with_gradients
from asysplat.benchmark.table import (
    error,
    limited,
    make_table,
    measured_on,
    number,
    spread,
    text,
)
from asysplat.benchmark.timing import Measurement, Result, time_in_rounds
from asysplat.errors import InputError

PASSES = {"forward": "Forward", "forward_backward": "Forward and backward"}
ERRORS = {"forward": "error.forward", "forward_backward": "error.gradients"}
LOOP, MATMULS = "loop", "matmuls"
MOST_OVER_MATMULS = 2.5  # is asked of ssd


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, times in seconds. The path "loop" is the
        reference in fp32 on a shorter sequence, its times scaled to the whole; "matmuls" are the
        operator's matrix products by themselves.

    Raises:
        InputError: an unknown precision or device, sizes an operator cannot take.
    """
    device = find_device(options.device)
    precisions = find_precisions("ops.precisions", options.ops.precisions)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    results: list[Result] = []
    for case, small in track(find_cases(sizes), "operators", console=console):
        rows = make_rows(case, small, precisions, sizes["loop_tokens"], device)
        time_in_rounds(rows, options.repeats)
        found = [row.found | {name: row.summary(name) for name in PASSES} for row in rows]
        results += [result | _compared(result, found) for result in found]
    return {"rows": results}


def make_rows(
    case: Case,
    small: Case,
    precisions: Mapping[str, torch.dtype],
    loop_tokens: int,
    device: torch.device,
) -> list[Measurement]:
    """Prepare the measurements of one operator: its paths, its bare products, the loop.

    Args:
        case: what is timed.
        small: one of its kind that errors are measured on.
        precisions: types of the inputs, by name.
        loop_tokens: length of the sequence that the loop is timed on.
    """
    rows = []
    for precision, dtype in precisions.items():
        exact = Path(small, "reference", dtype, device).truth()
        for backend in case.backends:
            if backend in {"cpu", "cuda"} - {device.type}:
                continue
            try:
                errors = Path(small, backend, dtype, device).errors(exact)
            except InputError:  # the operator has no such backend, or it cannot run here
                continue
            path = Path(case, backend, dtype, device)
            errors = {"measured_on": dict(small.sizes), **errors}
            row = _row(case, precision, backend, path.seconds, errors, path.bytes_per_token())
            rows.append(row)
        if case.products():
            timer = _product_timer(case, dtype, device)
            rows.append(_row(case, precision, MATMULS, timer, None, None))
    return [*rows, _loop(case, small, loop_tokens, device)] if case.operator in SCANS else rows


def _product_timer(
    case: Case, dtype: torch.dtype, device: torch.device
) -> Callable[[], dict[str, float]]:
    forward = products(case.products(), dtype, device)
    both = products(with_gradients(case.products()), dtype, device)  # those of the forward pass too

    def seconds() -> dict[str, float]:
        each = product_seconds(both, device)
        counts = zip(PASSES, (forward, both), strict=True)
        return {name: sum(n * each[product] for product, n in c.items()) for name, c in counts}

    return seconds


def _loop(case: Case, small: Case, tokens: int, device: torch.device) -> Measurement:
    """Prepare the reference in fp32, which takes one token after the other."""
    reference = Path(small, "reference", torch.float32, device)
    errors = {"measured_on": dict(small.sizes), **reference.errors(reference.truth())}
    length = min(tokens, case.sizes["length"])
    path = Path(case.resized(length=length), "reference", torch.float32, device)
    scale = case.sizes["length"] / length

    def seconds() -> dict[str, float]:
        return {name: scale * value for name, value in path.seconds().items()}

    row = _row(case, "fp32", LOOP, seconds, errors, path.bytes_per_token())
    row.found["loop_tokens"] = length
    return row


def _row(
    case: Case,
    precision: str,
    path: str,
    timer: Callable[[], Mapping[str, float]],
    error: Result | None,
    bytes_per_token: Result | None,
) -> Measurement:
    found = {"operator": case.name, "sizes": dict(case.sizes), "precision": precision, "path": path}
    found |= {"threads": torch.get_num_threads(), "error": error}
    return Measurement(timer, {**found, "bytes_per_token": bytes_per_token})


def _compared(result: Result, results: Sequence[Result]) -> Result:
    """Compare with the loop, and with the products at the same precision; None without them."""
    paths = {(other["path"], other["precision"]): other for other in results}
    loop, matmuls = paths.get((LOOP, "fp32")), paths.get((MATMULS, result["precision"]))
    return {
        "faster_than_loop": loop and _ratios(loop, result),
        "over_matmuls": matmuls and _ratios(result, matmuls),
    }


def _ratios(one: Result, other: Result) -> dict[str, float]:
    return {name: one[name]["median"] / other[name]["median"] for name in PASSES}


def tables(results: Result) -> list[Table]:
    """Show each pass: its time, against the sequential loop and bare matmuls; error; memory."""
    rows = results["rows"]
    loop = max((row["loop_tokens"] for row in rows if row["path"] == LOOP), default=0)
    notes = (
        f"{measured_on(results)}\n"
        f"loop: reference.py in fp32 on {loop} tokens, times scaled to the whole sequence\n"
        "matmuls: the operator's matrix products by themselves\n"
        "error: against the reference in float64, relative in L2; *: of a smaller one of its kind"
    )

    def columns(name: str) -> dict[str, Callable]:
        return {
            "operator": text("{operator}"),
            "inputs": text("{precision}"),
            "path": text("{path}"),
            "ms": spread(name),
            "loop\n/ path": number(f"faster_than_loop.{name}", "{:.1f}"),
            "path\n/ matmuls": limited(f"over_matmuls.{name}", MOST_OVER_MATMULS),
            "error": error(ERRORS[name]),
            "kB\n/ token": number(f"bytes_per_token.{name}", "{:.2f}", unit=1e3),
        }

    return [make_table(title, columns(name), rows, notes, 3) for name, title in PASSES.items()]


def plot(results: Result) -> Figure:
    """Plot the forward pass, and both passes."""
    errors = {
        "forward": ("output against float64, relative L2", ERRORS["forward"]),
        "forward_backward": (
            "worst gradient against float64, relative L2",
            ERRORS["forward_backward"],
        ),
    }
    rows = [row for row in results["rows"] if row["error"]]
    return time_against_error(rows, errors, backend="path", case="operator")
