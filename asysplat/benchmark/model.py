"""Whole networks: seconds of a forward pass and of a training step, their parts, their floor."""

import inspect
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from traceback import walk_stack
from types import FrameType

import hydra
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat import models, ops
from asysplat.benchmark.compare import RATIO, TIME, Watched
from asysplat.benchmark.options import PRECISIONS, check_names, find_device
from asysplat.benchmark.plot import bars
from asysplat.benchmark.products import Product, RecordProducts, time_products
from asysplat.benchmark.scenes import on_an_arc, random_scene
from asysplat.benchmark.table import machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, Run, now, seconds_of, time_in_rounds
from asysplat.evaluation.measured_cost import GB, memory_gb
from asysplat.evaluation.static_cost import activation_gb, count_parameters
from asysplat.models.network import Network
from asysplat.models.tokenizer import Tokenizer
from asysplat.overrides import check_overrides
from asysplat.scene import Gaussians, Views

WATCHED = Watched(
    names=("model", "views", "precision"),
    alike=("parameters", "height", "width"),
    kinds=dict.fromkeys(("forward", "step"), TIME)
    | dict.fromkeys(("over_floor.forward", "over_floor.step"), RATIO),
)
COMPONENTS = {  # none within another
    "tokenizer": (Tokenizer,),
    "Mamba2": (models.BiMamba2,),
    "sparse attention": (models.SparseAttention,),
    "full attention": (models.FullAttention,),
    "MambaVision": (models.MambaVision,),
    "cross-attention": (models.CoarseReadsFine, models.FineReadsCoarse),
    "head": (models.GaussianHead,),
}
OTHERS = "others"
PARTS = (*COMPONENTS, OTHERS)
OPERATORS = ("ssd", "selective_scan", "grid_attention")
LAYER_CODES = {inspect.unwrap(kind.forward).__code__ for k in COMPONENTS.values() for kind in k}
OPERATOR_CODES = {inspect.unwrap(getattr(ops, name)).__code__: name for name in OPERATORS}
BACKWARD = 2  # products in the backward pass for each of the forward pass
MAX_FILLED = 0.75  # of the memory, by the estimate of a step
NOTES = """\
floor: the forward pass's matrix products and convolutions by themselves; a step's is \
three times that
step: forward and backward; -: not measured, or would not fit into memory"""


@dataclass(frozen=True)
class Workload:
    """A network, its input and their precision."""

    net: Network  # with random weights
    precision: str  # of PRECISIONS; bf16 by autocast
    views: Views  # of one scene

    @property
    def device(self) -> torch.device:
        return self.views.images.device

    def forward(self) -> Gaussians:
        self.net.eval()
        with torch.no_grad(), self._autocast(self.device.type):
            return self.net(self.views)

    def step(self) -> None:
        """Run a training step without renderer and optimizer: the loss is a mean of the outputs."""
        self.net.train()
        with self._autocast(self.device.type):
            gaussians = self.net(self.views)
            means = [getattr(gaussians, field.name).float().mean() for field in fields(gaussians)]
        sum(means).backward()
        self.net.zero_grad(set_to_none=True)

    @property
    def step_gb(self) -> float:
        """Estimate the memory of a step: activations, parameters and their gradients."""
        cameras = self.views.cameras
        self.net.train()
        with self._autocast("cpu"):
            activations = activation_gb(self.net, cameras.num_views, cameras.height, cameras.width)
        return activations + 2 * 4 * count_parameters(self.net) / GB

    @property
    def step_fits(self) -> bool:
        return self.step_gb < MAX_FILLED * memory_gb(self.device)

    def _autocast(self, device: str) -> torch.autocast:
        dtype = PRECISIONS[self.precision]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


def make_net(
    name: str, overrides: Mapping[str, object], device: torch.device
) -> tuple[Network, dict[str, int]]:
    """Build the network that train.py would; return also its number of inputs, height and width.

    Raises:
        InputError: an unknown model, or an unknown choice among the overrides.
    """
    command = [f"model={name}", *(f"{key}={value}" for key, value in overrides.items())]
    check_overrides(command)
    config = hydra.compose("train", command)
    torch.manual_seed(0)
    with device:
        net = instantiate(config.model)
    return net, {name: config.data[name] for name in ("inputs", "height", "width")}


def make_views(views: int, height: int, width: int, device: torch.device) -> Views:
    """Make views of noise, from cameras on an arc."""
    _, camera = random_scene(1, height, width)
    images = torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(0))
    return Views(on_an_arc(camera, views), images).to(device)


def _component(frame: FrameType) -> str | None:
    """Return the component that a frame is a method of, if any."""
    layer = frame.f_locals.get("self")
    return next((name for name, kinds in COMPONENTS.items() if isinstance(layer, kinds)), None)


def part_seconds(forward: Run, device: torch.device) -> dict[str, float]:
    """Time one forward pass in each of PARTS and, within them, in each of OPERATORS."""
    seconds: dict[str, float] = {}

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        name = _component(frame) if code in LAYER_CODES else OPERATOR_CODES.get(code)
        if name is not None and event in ("call", "return"):
            clock = -now(device) if event == "call" else now(device)
            seconds[name] = seconds.get(name, 0.0) + clock

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        total = seconds_of(forward, device)
    finally:
        sys.setprofile(previous)
    return seconds | {OTHERS: total - sum(seconds.get(name, 0) for name in COMPONENTS)}


def record_products(forward: Run) -> dict[str, Counter[Product]]:
    """Count the products of one forward pass: in each of PARTS that has some; "forward", in all."""

    def running() -> str:
        names = (_component(frame) for frame, _ in walk_stack(sys._getframe()))
        return next(filter(None, names), OTHERS)

    with RecordProducts(running) as recorder:
        forward()
    return recorder.counts | {"forward": sum(recorder.counts.values(), Counter())}


def measure(options: DictConfig, console: Console) -> Result:
    """Time every network of `options.model`, `options.repeats` times.

    Returns:
        "rows": one for each network, number of views and precision, times in seconds. The floor is
        the time that the forward pass's matrix products take by themselves. A step that is not
        measured, or would not fit into memory, is None.
    """
    device, config = find_device(options.device), options.model
    check_names("model.precisions", config.precisions, PRECISIONS)
    measurements: list[Measurement] = []
    groups = {}  # the products of each part, by the row's number
    with console.status("networks, products and memory"):
        for name in config.names:
            net, size = make_net(name, config.overrides, device)
            net.check_size(size["height"], size["width"])
            for num_views in config.views or [size["inputs"]]:
                views = make_views(num_views, size["height"], size["width"], device)
                for precision in config.precisions:
                    workload = Workload(net, precision, views)
                    measurements.append(_prepare(name, workload, config.steps))
                    counts = record_products(workload.forward)
                    for part in ("forward", *PARTS):
                        groups[len(measurements) - 1, part] = counts.get(part, {})
    products = Measurement(lambda: time_products(groups, device))
    with console.status(f"{options.repeats} rounds"):
        time_in_rounds([*measurements, products], options.repeats)
    rows = []
    for i, timed in enumerate(measurements):
        times = {name: timed.summary(name) for name in timed.seconds}
        forward, step, floor = times["forward"], times.get("step"), products.summary((i, "forward"))
        over_floor = {"forward": forward["median"] / floor["median"]}
        over_floor["step"] = step and step["median"] / ((1 + BACKWARD) * floor["median"])
        row = timed.row | {"forward": forward, "step": step, "floor": floor}
        row |= {"over_floor": over_floor, "components": {}}
        for part in [name for name in PARTS if name in times]:
            own_floor = products.summary((i, part))["median"]
            row["components"][part] = {"seconds": times[part], "floor": own_floor}
        rows.append(row | {"operators": {name: times[name] for name in OPERATORS if name in times}})
    return {"rows": rows}


def _prepare(name: str, workload: Workload, steps: bool) -> Measurement:
    """Measure memory, and prepare what is timed."""
    device, cameras = workload.device, workload.views.cameras
    passes = {"forward": workload.forward}
    if steps and workload.step_fits:
        passes["step"] = workload.step

    def seconds() -> dict[str, float]:
        of_passes = {name: seconds_of(run, device) for name, run in passes.items()}
        return of_passes | part_seconds(workload.forward, device)

    row = {
        "model": name,
        "parameters": count_parameters(workload.net),
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
        "precision": workload.precision,
    }
    return Measurement(seconds, row)


def tables(results: Result) -> list[Table]:
    """Show every network, and what its forward pass consists of."""
    rows, parts = results["rows"], []
    for row in rows:
        own = [{"part": name, **part} for name, part in row["components"].items()]
        own += [{"part": f"  of which {n}", "seconds": s} for n, s in row["operators"].items()]
        for part in own:
            seconds, floor = part["seconds"]["median"], part.get("floor")
            part["share"] = seconds / row["forward"]["median"]
            part["over_floor"] = seconds / floor if floor else None
            parts.append(row | {"floor": None} | part)
    part_notes = "of which: operators, within the components that call them"
    return [
        make_table("Networks", NETWORKS, rows, f"{machine_note(results)}\n{NOTES}", names=2),
        make_table("Parts of a forward pass", FORWARD, parts, part_notes, names=3),
    ]


def plot(results: Result) -> Figure:
    """Plot the parts of a forward pass, for each view, and its floor."""
    rows = results["rows"]

    def milliseconds(seconds: Sequence[Result]) -> list[float]:
        pairs = zip(rows, seconds, strict=True)
        return [1000 / row["views"] * each.get("median", 0) for row, each in pairs]

    parts = {p: [row["components"].get(p, {}).get("seconds", {}) for row in rows] for p in PARTS}
    return bars(
        [f"{row['model']}, {row['views']} views, {row['precision']}" for row in rows],
        {part: milliseconds(seconds) for part, seconds in parts.items()},
        ("floor", milliseconds([row["floor"] for row in rows])),
        "milliseconds of a forward pass for each view",
    )


NETWORKS = {
    "model": text("{model}"),
    "inputs": text("{views} x {height}x{width}, {precision}"),
    "forward\nms": spread("forward"),
    "floor\nms": spread("floor"),
    "forward\n/ floor": number("over_floor.forward", "{:.2f}"),
    "step\nms": spread("step"),
    "step\n/ floor": number("over_floor.step", "{:.2f}"),
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
