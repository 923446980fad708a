"""The whole measurement, as plain numbers."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track

from asysplat.benchmark.choices import check_repeats, find_device, find_precisions
from asysplat.benchmark.ops.cases import find_cases
from asysplat.benchmark.ops.rows import LOOP, MATMULS, Row, make_rows
from asysplat.benchmark.products import product_timers, sum_of_products
from asysplat.benchmark.timing import rounds, run_timer, summary

PASSES = ("forward", "forward_backward")

Result = dict[str, Any]


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, times in seconds. The path "loop" is the
        reference in fp32 on a shorter sequence, its times scaled to the whole; "matmuls" are the
        operator's matrix products by themselves.

    Raises:
        InputError: repeats below 1, an unknown precision or device, sizes an operator cannot take.
    """
    check_repeats(options.repeats)
    device = find_device(options.device)
    precisions = find_precisions("ops.precisions", options.ops.precisions)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    results: list[Result] = []
    for case, small in track(find_cases(sizes), "operators", console=console):
        rows = make_rows(case, small, precisions, sizes["loop_tokens"], device)
        results += _measure_rows(rows, device, options.repeats)
    return {"rows": results}


def _measure_rows(rows: Sequence[Row], device: torch.device, repeats: int) -> list[Result]:
    """Of one operator, in the same rounds."""
    timers = []
    for number, row in enumerate(rows):
        timers += [run_timer((number, name), run, device) for name, run in row.runs.items()]
        # Both passes' products are those of the forward pass, and more.
        timers += product_timers(row.counts.get("forward_backward", {}), device)
    seconds = rounds(timers, repeats)
    results = []
    for number, row in enumerate(rows):
        times = {}
        for name in PASSES:
            if row.counts:
                found = sum_of_products(row.counts[name], seconds)
            else:
                found = [row.scale * value for value in seconds[number, name]]
            times[name] = summary(found)
        results.append(_describe(row) | times)
    return [result | _compared(result, results) for result in results]


def _describe(row: Row) -> Result:
    return {
        "operator": row.case.name,
        "sizes": asdict(row.case),
        "precision": row.precision,
        "path": row.path,
        "threads": torch.get_num_threads(),
        **row.found,
    }


def _compared(result: Result, results: Sequence[Result]) -> Result:
    """With the loop, and with the products at the same precision; None where there are none."""
    paths = {(other["path"], other["precision"]): other for other in results}
    loop, matmuls = paths.get((LOOP, "fp32")), paths.get((MATMULS, result["precision"]))
    return {
        "faster_than_loop": loop and _ratios(loop, result),
        "over_matmuls": matmuls and _ratios(result, matmuls),
    }


def _ratios(one: Result, other: Result) -> dict[str, float]:
    return {name: one[name]["median"] / other[name]["median"] for name in PASSES}
