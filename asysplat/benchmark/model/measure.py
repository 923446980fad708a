"""The whole measurement, as plain numbers."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console

from asysplat.benchmark.choices import check_repeats, find_device, find_precisions
from asysplat.benchmark.model.components import (
    COMPONENTS,
    OPERATORS,
    OTHERS,
    component_seconds,
    record_products,
)
from asysplat.benchmark.model.task import Task, make_net, make_views
from asysplat.benchmark.products import Product, product_timers, sum_of_products
from asysplat.benchmark.timing import Run, Timer, rise_gb, rounds, run_timer, summary
from asysplat.evaluation.cost import GB, count_parameters
from asysplat.evaluation.static_cost import GIGA

PASSES = ("forward", "step")
BACKWARD = 2  # products in the backward pass for each of the forward pass

Result = dict[str, Any]
Counts = Mapping[str, Mapping[Product, int]]


@dataclass
class _Row:
    """A network at one precision and number of views.

    Args:
        passes: what is timed of it, by name.
        counts: of products, by component.
    """

    task: Task
    passes: Mapping[str, Run]
    counts: Counts
    result: Result


def measure(options: DictConfig, console: Console) -> Result:
    """Time every network of `options.model`, `options.repeats` times.

    Returns:
        "rows": one for each network, number of views and precision, times in seconds. The floor is
        the time that the forward pass's matrix products take by themselves. A step that was
        not asked for, or would not fit into memory, is None.

    Raises:
        InputError: repeats below 1; an unknown model, word, precision or device; a resolution that
            a network cannot take.
    """
    check_repeats(options.repeats)
    device = find_device(options.device)
    wanted = options.model
    precisions = find_precisions("model.precisions", wanted.precisions)
    rows = []
    with console.status("networks, products and memory"):
        for name in wanted.names:
            net, size = make_net(name, wanted.words, device)
            net.check_size(size["height"], size["width"])
            for count in wanted.views or [size["views"]]:
                views = make_views(count, size["height"], size["width"], device)
                for precision, dtype in precisions.items():
                    task = Task(name, net, precision, dtype, views)
                    rows.append(_prepare(task, wanted.steps))
    with console.status(f"{options.repeats} rounds"):
        _measure_rows(rows, device, options.repeats)
    return {"rows": [row.result for row in rows]}


def _prepare(task: Task, steps: bool) -> _Row:
    """What is known before anything is timed."""
    passes = {"forward": task.forward}
    if steps and task.step_fits:
        passes["step"] = task.step
    cameras = task.views.cameras
    counts = record_products(task)
    result = {
        "model": task.name,
        "parameters": count_parameters(task.net),
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
        "tokens": task.tokens,
        "precision": task.precision,
        "threads": torch.get_num_threads(),
        "gflops": sum(n * p.flops() for p, n in _all_of(counts).items()) / GIGA,
        "step_needs_gb": task.step_gb,
        "peak_gb": {name: rise_gb(run, task.device) for name, run in passes.items()},
    }
    result["bytes_per_token"] = {
        name: GB * value / task.tokens for name, value in result["peak_gb"].items()
    }
    return _Row(task, passes, counts, result)


def _all_of(counts: Counts) -> Counter[Product]:
    return sum((Counter(part) for part in counts.values()), Counter())


def _measure_rows(rows: list[_Row], device: torch.device, repeats: int) -> None:
    """Everything in the same rounds, each product once whoever it belongs to."""
    timers: list[Timer] = []
    every: Counter[Product] = Counter()
    for number, row in enumerate(rows):
        timers += [run_timer((number, name), run, device) for name, run in row.passes.items()]
        timers.append(_component_timer(number, row.task))
        every |= _all_of(row.counts)
    timers += product_timers(every, device)
    seconds = rounds(timers, repeats)
    for number, row in enumerate(rows):
        row.result |= _times(number, row, seconds)
    for row in rows:
        row.result["over_first"] = {
            name: _over_first(name, row.result, rows[0].result["model"], rows) for name in PASSES
        }


def _component_timer(number: int, task: Task) -> Timer:
    return lambda: {(number, name): value for name, value in component_seconds(task).items()}


def _times(number: int, row: _Row, seconds: Mapping[Any, list[float]]) -> Result:
    found = {name: summary(seconds[number, name]) for name in row.passes}
    floor = summary(sum_of_products(_all_of(row.counts), seconds))
    step = found.get("step")
    return {
        "forward": found["forward"],
        "step": step,
        "floor": floor,
        "over_floor": {
            "forward": found["forward"]["median"] / floor["median"],
            "step": step and step["median"] / ((1 + BACKWARD) * floor["median"]),
        },
        "components": {
            name: _component(seconds[number, name], row.counts.get(name, {}), seconds)
            for name in (*COMPONENTS, OTHERS)
            if (number, name) in seconds
        },
        "operators": {
            name: summary(seconds[number, name]) for name in OPERATORS if (number, name) in seconds
        },
        "products": [
            {
                "product": str(product),
                "count": count,
                "gflops": product.flops() / GIGA,
                "seconds": summary(seconds[product])["median"],
            }
            for product, count in _all_of(row.counts).items()
        ],
    }


def _component(
    measured: list[float], counts: Mapping[Product, int], seconds: Mapping[Any, list[float]]
) -> Result:
    floor = summary(sum_of_products(counts, seconds))["median"] if counts else 0.0
    return {"seconds": summary(measured), "floor": floor}


def _over_first(name: str, result: Result, first: str, rows: list[_Row]) -> float | None:
    """A pass's time over that of the first model, on the same views at the same precision."""
    wanted = {**{key: result[key] for key in ("views", "precision")}, "model": first}
    for row in rows:
        if wanted.items() <= row.result.items() and row.result[name] and result[name]:
            return result[name]["median"] / row.result[name]["median"]
    return None
