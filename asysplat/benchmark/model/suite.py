"""Whole networks: seconds of a forward pass and of a training step, their parts, their floor."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.benchmark.model.components import (
    COMPONENTS,
    OPERATORS,
    OTHERS,
    component_seconds,
    record_products,
)
from asysplat.benchmark.model.workload import Workload, make_net, make_views
from asysplat.benchmark.options import find_device, find_precisions
from asysplat.benchmark.plot import bars
from asysplat.benchmark.products import Counts, product_seconds, sum_of_products
from asysplat.benchmark.table import limited, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import (
    Measurement,
    Result,
    rise_gb,
    seconds_of,
    summary,
    time_in_rounds,
)
from asysplat.evaluation.cost import GB, count_parameters
from asysplat.evaluation.static_cost import GIGA

PASSES = ("forward", "step")
BACKWARD = 2  # products in the backward pass for each of the forward pass
MOST_OVER_FLOOR = 2.5  # is asked of the forward pass
NOTES = """\
floor: the forward pass's matrix products and convolutions by themselves; a step's is \
three times that
step: forward and backward; -: not asked for, or would not fit into memory
/ first: to the first model at this precision and number of views
tokens: those of the largest patch"""


@dataclass
class _Network(Measurement):
    """The measurement of a network at one precision and number of views.

    Args:
        counts: of the products of a forward pass, by component.
    """

    counts: Mapping[str, Counts] = field(default_factory=dict)

    @property
    def all_counts(self) -> Counts:
        return sum(map(Counter, self.counts.values()), Counter())


def measure(options: DictConfig, console: Console) -> Result:
    """Time every network of `options.model`, `options.repeats` times.

    Returns:
        "rows": one for each network, number of views and precision, times in seconds. The floor is
        the time that the forward pass's matrix products take by themselves. A step that was
        not asked for, or would not fit into memory, is None.

    Raises:
        InputError: an unknown model, override, precision or device; a resolution
            that a network cannot take.
    """
    device = find_device(options.device)
    wanted = options.model
    precisions = find_precisions("model.precisions", wanted.precisions)
    rows = []
    with console.status("networks, products and memory"):
        for name in wanted.names:
            net, size = make_net(name, wanted.overrides, device)
            net.check_size(size["height"], size["width"])
            for count in wanted.views or [size["views"]]:
                views = make_views(count, size["height"], size["width"], device)
                for precision, dtype in precisions.items():
                    workload = Workload(name, net, precision, dtype, views)
                    rows.append(_prepare(workload, wanted.steps))
    every: Counter = Counter()  # each product once, whatever network it belongs to
    for row in rows:
        every |= row.all_counts
    products = Measurement(lambda: product_seconds(every, device))
    with console.status(f"{options.repeats} rounds"):
        time_in_rounds([*rows, products], options.repeats)
    results = [row.found | _times(row, products) for row in rows]
    first = [result for result in results if result["model"] == results[0]["model"]]
    return {"rows": [result | {"over_first": _over_first(result, first)} for result in results]}


def _prepare(workload: Workload, steps: bool) -> _Network:
    """Find what is known before anything is timed."""
    device, cameras = workload.device, workload.views.cameras
    passes = {"forward": workload.forward}
    if steps and workload.step_fits:
        passes["step"] = workload.step

    def seconds() -> dict[str, float]:
        taken = {name: seconds_of(run, device) for name, run in passes.items()}
        return taken | component_seconds(workload)

    row = _Network(seconds, counts=record_products(workload))
    peak_gb = {name: rise_gb(run, device) for name, run in passes.items()}
    row.found = {
        "model": workload.name,
        "parameters": count_parameters(workload.net),
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
        "tokens": workload.tokens,
        "precision": workload.precision,
        "threads": torch.get_num_threads(),
        "gflops": sum(count * p.flops() for p, count in row.all_counts.items()) / GIGA,
        "step_needs_gb": workload.step_gb,
        "peak_gb": peak_gb,
        "bytes_per_token": {name: GB * gb / workload.tokens for name, gb in peak_gb.items()},
    }
    return row


def _times(row: _Network, products: Measurement) -> Result:
    """Summarise the rounds."""
    forward, step = (row.summary(name) if name in row.seconds else None for name in PASSES)
    floor = summary(sum_of_products(row.all_counts, products.seconds))
    return {
        "forward": forward,
        "step": step,
        "floor": floor,
        "over_floor": {
            "forward": forward["median"] / floor["median"],
            "step": step and step["median"] / ((1 + BACKWARD) * floor["median"]),
        },
        "components": {
            name: {"seconds": row.summary(name), "floor": _floor(row.counts.get(name), products)}
            for name in (*COMPONENTS, OTHERS)
            if name in row.seconds
        },
        "operators": {name: row.summary(name) for name in OPERATORS if name in row.seconds},
        "products": [
            {
                "product": str(product),
                "count": count,
                "gflops": product.flops() / GIGA,
                "seconds": products.summary(product)["median"],
            }
            for product, count in row.all_counts.items()
        ],
    }


def _floor(counts: Counts | None, products: Measurement) -> float:
    return summary(sum_of_products(counts, products.seconds))["median"] if counts else 0.0


def _over_first(result: Result, first: Sequence[Result]) -> dict[str, float | None]:
    """Divide by the times of the first model, on the same views at the same precision."""
    over: dict[str, float | None] = dict.fromkeys(PASSES)
    for other in first:
        if all(other[key] == result[key] for key in ("views", "precision")):
            for name in PASSES:
                if result[name] and other[name]:
                    over[name] = result[name]["median"] / other[name]["median"]
    return over


def tables(results: Result) -> list[Table]:
    """Show every network; what its forward pass goes into; where views vary, the time of each."""
    rows = results["rows"]
    network_notes = f"{measured_on(results)}\n{NOTES}"
    part_notes = "of which: operators, within the components that call them"
    parts = [part for row in rows for part in _parts(row)]
    shown = [
        make_table("Networks", NETWORKS, rows, network_notes, names=2),
        make_table("What a forward pass goes into", PARTS, parts, part_notes, names=3),
    ]
    if len({row["views"] for row in rows}) > 1:
        title = "Milliseconds of a forward pass for each view"
        shown.append(make_table(title, VIEWS, [_per_view(row) for row in rows], names=2))
    return shown


def plot(results: Result) -> Figure:
    """Plot what a forward pass goes into, for each view, and its floor."""
    rows = [_per_view(row) for row in results["rows"]]
    return bars(
        [f"{row['model']}, {row['views']} views, {row['precision']}" for row in rows],
        {name: [row.get(name, 0) for row in rows] for name in (*COMPONENTS, OTHERS)},
        ("floor", [row["floor"] for row in rows]),
        "milliseconds of a forward pass for each view",
    )


def _parts(row: Result) -> list[Result]:
    """List the components and, below, the operators."""
    lines = [
        {"part": name, **part, "over_floor": _over(part["seconds"], part["floor"])}
        for name, part in row["components"].items()
    ]
    lines += [
        {"part": f"  of which {name}", "seconds": seconds, "floor": None, "over_floor": None}
        for name, seconds in row["operators"].items()
    ]
    whole = row["forward"]["median"]
    return [row | line | {"share": line["seconds"]["median"] / whole} for line in lines]


def _over(seconds: Mapping[str, float], floor: float) -> float | None:
    return seconds["median"] / floor if floor else None


def _per_view(row: Result) -> Result:
    """Give the milliseconds for each view of all that is timed of a forward pass, by name."""
    timed = {name: part["seconds"] for name, part in row["components"].items()}
    timed |= row["operators"] | {"forward": row["forward"], "floor": row["floor"]}
    each = {name: 1000 * seconds["median"] / row["views"] for name, seconds in timed.items()}
    return row | each


NETWORKS = {
    "model": text("{model}"),
    "inputs": text("{views} x {height}x{width}, {precision}"),
    "forward\nms": spread("forward"),
    "floor\nms": spread("floor"),
    "forward\n/ floor": limited("over_floor.forward", MOST_OVER_FLOOR),
    "forward\n/ first": number("over_first.forward", "{:.2f}"),
    "step\nms": spread("step"),
    "step\n/ floor": number("over_floor.step", "{:.2f}"),
    "step\n/ first": number("over_first.step", "{:.2f}"),
    "forward\nkB / token": number("bytes_per_token.forward", "{:,.0f}", unit=1e3),
    "step\nkB / token": number("bytes_per_token.step", "{:,.0f}", unit=1e3),
    "step\nGB": number("peak_gb.step", "{:.2f}"),
}
PARTS = {
    "model": text("{model}"),
    "inputs": text("{views} views, {precision}"),
    "component": text("{part}"),
    "ms": spread("seconds"),
    "share\n%": number("share", "{:.1f}", unit=0.01),
    "floor\nms": number("floor", "{:.1f}", unit=1e-3),
    "/ floor": number("over_floor", "{:.2f}"),
}
VIEWS = {
    "model": text("{model}"),
    "inputs": text("{views} views, {precision}"),
    "all": number("forward", "{:.2f}"),
    "appearance\nlayers": number("MambaVision", "{:.2f}"),
    "ssd": number("ssd", "{:.2f}"),
    "selective\nscan": number("selective_scan", "{:.2f}"),
    "grid\nattention": number("grid_attention", "{:.2f}"),
}
