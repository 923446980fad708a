"""Whole networks: seconds of a forward pass and of a training step, their parts, their floor."""

from collections.abc import Mapping

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.benchmark.compare import RATIO, TIME, Watched
from asysplat.benchmark.model.components import OPERATORS, PARTS, part_seconds, record_products
from asysplat.benchmark.model.workload import Workload, make_net, make_views
from asysplat.benchmark.options import PRECISIONS, check_names, find_device
from asysplat.benchmark.plot import bars
from asysplat.benchmark.products import Counts, time_products
from asysplat.benchmark.table import limited, make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import (
    Measurement,
    Result,
    ratios,
    rise_gb,
    seconds_of,
    time_in_rounds,
)
from asysplat.evaluation.cost import GB, count_parameters
from asysplat.evaluation.static_cost import GIGA

PASSES = ("forward", "step")
WATCHED = Watched(
    names=("model", "views", "precision"),
    alike=("parameters", "height", "width"),
    kinds={
        "forward": TIME,
        "step": TIME,
        "over_floor.forward": RATIO,
        "over_floor.step": RATIO,
    },
)
BACKWARD = 2  # products in the backward pass for each of the forward pass
MOST_OVER_FLOOR = 2.5  # is asked of the forward pass
NOTES = """\
floor: the forward pass's matrix products and convolutions by themselves; a step's is \
three times that
step: forward and backward; -: not asked for, or would not fit into memory
/ first: to the first model at this precision and number of views
tokens: those of the largest patch"""


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
    device, wanted = find_device(options.device), options.model
    check_names("model.precisions", wanted.precisions, PRECISIONS)
    rows: list[Measurement] = []
    counts: list[Mapping[str, Counts]] = []  # of the products of each row, by part
    with console.status("networks, products and memory"):
        for name in wanted.names:
            net, size = make_net(name, wanted.overrides, device)
            net.check_size(size["height"], size["width"])
            for num_views in wanted.views or [size["inputs"]]:
                views = make_views(num_views, size["height"], size["width"], device)
                for precision in wanted.precisions:
                    workload = Workload(name, net, precision, views)
                    rows.append(_prepare(workload, wanted.steps))
                    counts.append(record_products(workload.forward))
    parts = ("forward", *PARTS)
    groups = {(i, part): c.get(part, {}) for i, c in enumerate(counts) for part in parts}
    products = Measurement(lambda: time_products(groups, device))
    with console.status(f"{options.repeats} rounds"):
        time_in_rounds([*rows, products], options.repeats)
    results, first = [], {}
    for i, row in enumerate(rows):
        floors = {part: products.summary((i, part)) for part in parts}
        result = row.found | _summarize(row, floors, counts[i]["forward"], products)
        same_input = first.setdefault((result["views"], result["precision"]), result)
        results.append(result | {"over_first": ratios(result, same_input, PASSES)})
    return {"rows": results}


def _prepare(workload: Workload, steps: bool) -> Measurement:
    """Find what is known before anything is timed."""
    device, cameras = workload.device, workload.views.cameras
    passes = {"forward": workload.forward}
    if steps and workload.step_fits:
        passes["step"] = workload.step

    def seconds() -> dict[str, float]:
        taken = {name: seconds_of(run, device) for name, run in passes.items()}
        return taken | part_seconds(workload.forward, device)

    peak_gb = {name: rise_gb(run, device) for name, run in passes.items()}
    found = {
        "model": workload.name,
        "parameters": count_parameters(workload.net),
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
        "tokens": workload.tokens,
        "precision": workload.precision,
        "threads": torch.get_num_threads(),
        "step_needs_gb": workload.step_gb,
        "peak_gb": peak_gb,
        "bytes_per_token": {name: GB * gb / workload.tokens for name, gb in peak_gb.items()},
    }
    return Measurement(seconds, found)


def _summarize(
    row: Measurement, floors: Mapping[str, Result], counts: Counts, products: Measurement
) -> Result:
    """Summarize the rounds of a network, and of the products of its forward pass."""
    times = {name: row.summary(name) for name in row.seconds}
    forward, step, floor = times["forward"], times.get("step"), floors["forward"]
    return {
        "forward": forward,
        "step": step,
        "floor": floor,
        "over_floor": {
            "forward": forward["median"] / floor["median"],
            "step": step and step["median"] / ((1 + BACKWARD) * floor["median"]),
        },
        "components": {
            name: {"seconds": times[name], "floor": floors[name]["median"]}
            for name in PARTS
            if name in times
        },
        "operators": {name: times[name] for name in OPERATORS if name in times},
        "gflops": sum(count * product.flops() for product, count in counts.items()) / GIGA,
        "products": [
            {
                "product": str(product),
                "count": count,
                "gflops": product.flops() / GIGA,
                "seconds": products.summary(product)["median"],
            }
            for product, count in counts.items()
        ],
    }


def tables(results: Result) -> list[Table]:
    """Show every network; what its forward pass goes into; where views vary, the time of each."""
    rows = results["rows"]
    network_notes = f"{measured_on(results)}\n{NOTES}"
    part_notes = "of which: operators, within the components that call them"
    parts = [part for row in rows for part in _parts(row)]
    shown = [
        make_table("Networks", NETWORKS, rows, network_notes, names=2),
        make_table("What a forward pass goes into", FORWARD, parts, part_notes, names=3),
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
        {name: [row.get(name, 0) for row in rows] for name in PARTS},
        ("floor", [row["floor"] for row in rows]),
        "milliseconds of a forward pass for each view",
    )


def _parts(row: Result) -> list[Result]:
    """List the components and, below, the operators."""
    parts = [{"part": name, **part} for name, part in row["components"].items()]
    parts += [
        {"part": f"  of which {name}", "seconds": seconds, "floor": None}
        for name, seconds in row["operators"].items()
    ]
    for part in parts:
        seconds, floor = part["seconds"]["median"], part["floor"]
        part["share"] = seconds / row["forward"]["median"]
        part["over_floor"] = seconds / floor if floor else None
    return [row | part for part in parts]


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
FORWARD = {
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
