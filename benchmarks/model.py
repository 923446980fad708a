"""Whole networks: seconds of a training step, and of a forward pass and its parts."""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from types import FrameType

import hydra
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat import models, ops
from asysplat.evaluation.measured_cost import peak_memory_gb, reset_peak_memory
from asysplat.evaluation.static_cost import count_parameters
from asysplat.models.layers import Tokenizer
from asysplat.models.network import Network
from asysplat.overrides import check_overrides
from asysplat.runs.machine import find_device
from asysplat.scene import Gaussians, Views
from benchmarks.compare import TIME, TrackedMetrics
from benchmarks.options import PRECISIONS, check_names
from benchmarks.plot import bars
from benchmarks.scenes import place_on_arc, random_scene
from benchmarks.table import machine_note, make_table, median_iqr_column, number_column, text_column
from benchmarks.timing import Measurement, Result, Run, device_time, measure_run, time_in_rounds

TRACKED = TrackedMetrics(
    names=("model", "views", "precision"),
    must_match=("parameters", "scenes", "checkpointing", "height", "width"),
    kinds=dict.fromkeys(("forward", "step"), TIME),
)
COMPONENTS = {  # layers, none of which contains another
    "tokenizer": (Tokenizer,),
    "Mamba2": (models.BiMamba2,),
    "sparse attention": (models.SparseAttention,),
    "full attention": (models.FullAttention,),
    "MambaVision": (models.MambaVision,),
    "cross-attention": (models.FineToCoarse, models.CoarseToFine),
    "head": (models.GaussianHead,),
}
OTHERS = "others"
PARTS = (*COMPONENTS, OTHERS)
OPERATORS = ("ssd", "selective_scan", "grid_attention")
LAYER_CODES = {inspect.unwrap(kind.forward).__code__ for k in COMPONENTS.values() for kind in k}
OPERATOR_CODES = {inspect.unwrap(getattr(ops, name)).__code__: name for name in OPERATORS}
NOTES = "step: forward and backward; GB: its peak (on a CPU the process's); -: not measured"


@dataclass(frozen=True)
class Workload:
    """A network, its input, and the precision of its forward pass."""

    net: Network  # with random weights
    precision: str  # key of PRECISIONS; bf16 by autocast
    views: Views  # input views, [scenes, V]

    @property
    def device(self) -> torch.device:
        return self.views.images.device

    def forward(self) -> Gaussians:
        self.net.eval()
        with torch.no_grad(), self._autocast(self.device.type):
            return self.net(self.views)

    def step(self) -> None:
        """Run a training step, in which the sum of the fields' means replaces render and loss."""
        self.net.train()
        with self._autocast(self.device.type):
            gaussians = self.net(self.views)
            means = [getattr(gaussians, field.name).float().mean() for field in fields(gaussians)]
        sum(means).backward()
        self.net.zero_grad(set_to_none=True)

    def measure_peak_gb(self) -> float | None:
        """Run a training step; return its peak memory, see `peak_memory_gb`, if it is known."""
        known = reset_peak_memory(self.device)
        self.step()
        return peak_memory_gb(self.device) if known else None

    def _autocast(self, device: str) -> torch.autocast:
        dtype = PRECISIONS[self.precision]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


def make_net(
    name: str, overrides: Mapping[str, object], device: torch.device
) -> tuple[Network, dict[str, int]]:
    """Build the network that train.py would build.

    Returns:
        The network, and its "inputs" (number of input views), "height" and "width".
    """
    command = [f"model={name}", *(f"{key}={value}" for key, value in overrides.items())]
    check_overrides(command)
    config = hydra.compose("train", command)
    torch.manual_seed(0)
    with device:
        net = instantiate(config.model)
    return net, {name: config.data[name] for name in ("inputs", "height", "width")}


def make_views(scenes: int, views: int, height: int, width: int, device: torch.device) -> Views:
    """Make views of noise from cameras on an arc; the same numbers for every scene and call."""
    _, camera = random_scene(1, height, width)
    images = torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(0))
    return Views.stack([Views(place_on_arc(camera, views), images)] * scenes).to(device)


def time_parts(forward: Run, device: torch.device) -> dict[str, float]:
    """Return the seconds of a forward pass in each of PARTS and, within these, of OPERATORS."""
    seconds: dict[str, float] = {}

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        name = OPERATOR_CODES.get(code)
        if code in LAYER_CODES:
            layer = frame.f_locals.get("self")
            name = next((n for n, kinds in COMPONENTS.items() if isinstance(layer, kinds)), None)
        if name is not None and event in ("call", "return"):
            clock = -device_time(device) if event == "call" else device_time(device)
            seconds[name] = seconds.get(name, 0.0) + clock

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        total = measure_run(forward, device)
    finally:
        sys.setprofile(previous)
    return seconds | {OTHERS: total - sum(seconds.get(name, 0) for name in COMPONENTS)}


def measure(options: DictConfig, console: Console) -> Result:
    """Time every network of `options.model`, `options.repeats` times.

    Returns:
        "rows": one for each network, number of views and precision, with times in seconds; "step"
        is None if it is not measured.
    """
    device, config = find_device(options.device), options.model
    check_names("model.precisions", config.precisions, PRECISIONS)
    measurements: list[Measurement] = []
    for name in track(config.names, "networks", console=console):
        net, size = make_net(name, config.overrides, device)
        net.check_size(size["height"], size["width"])
        net.checkpoint_layers(config.checkpoint_layers)
        for num_views in config.views or [size["inputs"]]:
            views = make_views(config.scenes, num_views, size["height"], size["width"], device)
            row = {"model": name, "parameters": count_parameters(net), "views": num_views}
            row |= {"height": size["height"], "width": size["width"]}
            row |= {"scenes": config.scenes, "checkpointing": config.checkpoint_layers}
            for precision in config.precisions:
                workload = Workload(net, precision, views)
                row = row | {"precision": precision}
                row["step_gb"] = workload.measure_peak_gb() if config.steps else None
                timer = partial(_time_workload, workload, config.steps)
                measurements.append(Measurement(timer, row))
    time_in_rounds(measurements, options.repeats, console)
    rows = []
    for timed in measurements:
        times = {name: timed.summarize(name) for name in timed.seconds}
        row = timed.row | {"forward": times["forward"], "step": times.get("step")}
        row["components"] = {name: {"seconds": times[name]} for name in PARTS if name in times}
        rows.append(row | {"operators": {name: times[name] for name in OPERATORS if name in times}})
    return {"rows": rows}


def _time_workload(workload: Workload, step: bool) -> dict[str, float]:
    seconds = {"forward": measure_run(workload.forward, workload.device)}
    if step:
        seconds["step"] = measure_run(workload.step, workload.device)
    return seconds | time_parts(workload.forward, workload.device)


def tables(results: Result) -> list[Table]:
    """Show the times of every network, and the share of each part in its forward pass."""
    rows, parts = results["rows"], []
    for row in rows:
        timed = {name: part["seconds"] for name, part in row["components"].items()}
        timed |= {f"  of which {name}": seconds for name, seconds in row["operators"].items()}
        for name, seconds in timed.items():
            fraction = seconds["median"] / row["forward"]["median"]
            parts.append(row | {"part": name, "seconds": seconds, "share": fraction})
    networks = {
        "model": text_column("{model}"),
        "inputs": text_column("{scenes} x {views} x {height}x{width}, {precision}"),
        "forward\nms": median_iqr_column("forward"),
        "step\nms": median_iqr_column("step"),
        "GB": number_column("step_gb", "{:.1f}"),
    }
    components = {
        "model": text_column("{model}"),
        "inputs": text_column("{views} views, {precision}"),
        "component": text_column("{part}"),
        "ms": median_iqr_column("seconds"),
        "share\n%": number_column("share", "{:.1f}", unit=0.01),
    }
    part_notes = "of which: operators, within the components that call them"
    return [
        make_table("Networks", networks, rows, f"{machine_note(results)}\n{NOTES}", names=2),
        make_table("Parts of a forward pass", components, parts, part_notes, names=3),
    ]


def plot(results: Result) -> Figure:
    """Plot the milliseconds of each part of a forward pass, per input view."""
    rows = results["rows"]

    def milliseconds(part: str) -> list[float]:
        parts = [row["components"].get(part) for row in rows]
        medians = [part["seconds"]["median"] if part else 0.0 for part in parts]
        return [1000 * median / row["views"] for row, median in zip(rows, medians, strict=True)]

    names = [f"{row['model']}, {row['views']} views, {row['precision']}" for row in rows]
    label = "milliseconds of a forward pass per view"
    return bars(names, {part: milliseconds(part) for part in PARTS}, label)
