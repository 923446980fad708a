"""Every path of the operators: time beside the sequential loop and bare products; error."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat import ops
from asysplat.benchmark.compare import ERROR, TIME, Watched
from asysplat.benchmark.options import PRECISIONS, check_names, find_device
from asysplat.benchmark.plot import time_against_error
from asysplat.benchmark.products import (
    Size,
    grid_attention_sizes,
    products,
    ssd_sizes,
    time_products,
    with_gradients,
)
from asysplat.benchmark.scenes import (
    DISTANCE,
    FOCAL,
    camera_at_origin,
    on_an_arc,
    random_numbers,
)
from asysplat.benchmark.table import error, machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import (
    Measurement,
    Result,
    Timer,
    ratios,
    relative_l2,
    seconds_of,
    time_in_rounds,
)
from asysplat.errors import InputError
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.scene import Cameras

PASSES = {"forward": "Forward", "forward_backward": "Forward and backward"}
ERRORS = {"forward": "error.forward", "forward_backward": "error.gradients"}
WATCHED = Watched(
    names=("operator", "precision", "path"),
    alike=("sizes", "loop_tokens", "error.measured_on"),
    kinds=dict.fromkeys(PASSES, TIME) | dict.fromkeys(ERRORS.values(), ERROR),
)
LOOP, REFERENCE, MATMULS = "loop", "reference", "matmuls"
NOTES = """\
loop: reference.py in fp32 on {loop} tokens, times scaled to the whole sequence; of plane_sweep \
the reference
matmuls: the operator's matrix products by themselves
error: against the reference in float64, relative in L2; *: of a smaller one of its kind"""

STEPS = (1e-3, 1e-1)  # dt of an untrained network
SCANS = ("ssd", "selective_scan")
FP32_INPUTS = ("dt", "A", "D")
# The shape of each input, in the order that they are drawn.
SHAPES = {
    "ssd": {  # a Mamba2 layer's scan, of one direction
        "x": "batch length heads head_dim",
        "dt": "batch length heads",
        "A": "heads",
        "B": "batch length state",
        "C": "batch length state",
        "D": "heads",
    },
    "selective_scan": {  # a MambaVision layer's scan: each image is a sequence
        "x": "batch length channels",
        "dt": "batch length channels",
        "A": "channels state",
        "B": "batch length state",
        "C": "batch length state",
        "D": "channels",
    },
    # One attention layer; grid 1 is full attention.
    "grid_attention": dict.fromkeys("qkv", "batch views height width heads head_dim"),
}
PRODUCTS = {"ssd": ssd_sizes, "grid_attention": grid_attention_sizes}
# The plane sweep's scene: cameras on an arc before a slanted wall with a texture.
SLANT = 0.3  # by which the wall is farther away, a unit to the right
WAVES = 20  # of each color

Tensors = dict[str, Tensor]
Gradients = tuple[Tensor, Tensors]  # the output, and the gradient of each input


@dataclass(frozen=True)
class OpCase:
    """An operator at one size."""

    operator: str  # of `asysplat.ops`
    sizes: Mapping[str, int]  # of its inputs, as SHAPES names them, and the grid of an attention
    exact: Mapping[str, int] = field(default_factory=dict)  # sizes that differ for errors

    differentiable = True
    precisions = tuple(PRECISIONS)  # in which it computes

    @property
    def name(self) -> str:
        return "/".join([self.operator, *map(str, self.options.values())])

    @property
    def options(self) -> dict[str, int]:
        """Return the arguments of the operator besides tensors."""
        return {"grid": self.sizes["grid"]} if "grid" in self.sizes else {}

    @property
    def backends(self) -> tuple[str, ...]:
        return ("chunked" if self.operator in SCANS else "sdpa", "cpu", "cuda")

    @property
    def small(self) -> "OpCase":
        """Return the case of its kind that errors are measured on."""
        return self.resized(**self.exact)

    def resized(self, **sizes: int) -> "OpCase":
        return replace(self, sizes={**self.sizes, **sizes})

    def tensors(self) -> Tensors:
        """Make inputs in float64; the same numbers at every call."""
        uniform, normal = random_numbers(0)
        tensors = {}
        for name, sides in SHAPES[self.operator].items():
            shape = [self.sizes[side] for side in sides.split()]
            if name == "dt":  # log-uniform
                low, high = map(math.log, STEPS)
                tensors[name] = (low + (high - low) * uniform(shape)).exp()
            elif name != "A":
                tensors[name] = normal(shape)
            elif self.operator == "ssd":
                tensors[name] = -1 - 15 * uniform(shape)
            else:
                states = torch.arange(1.0, self.sizes["state"] + 1, dtype=torch.float64)
                tensors[name] = -states.repeat(self.sizes["channels"], 1)
        return tensors

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return getattr(ops, self.operator)(**tensors, **self.options, backend=backend)

    def products(self) -> list[Size]:
        """List its matrix products; a selective scan has none."""
        return PRODUCTS[self.operator](**self.sizes) if self.operator in PRODUCTS else []


@dataclass(frozen=True)
class PlaneSweepCase(OpCase):
    """A plane sweep, which has no gradients and computes in fp32 alone."""

    differentiable = False
    precisions = ("fp32",)
    backends = (REFERENCE, "cpu", "cuda")

    @property
    def options(self) -> dict[str, int]:
        return {name: self.sizes[name] for name in ("stride", "planes", "neighbors")}

    @property
    def name(self) -> str:
        return self.operator

    def tensors(self) -> Tensors:
        """Make images and their cameras in float64; the same numbers at every call."""
        height, width = self.sizes["height"], self.sizes["width"]
        camera = camera_at_origin(FOCAL * width, height, width)
        cameras = on_an_arc(camera, self.sizes["views"]).to(torch.float64)
        tensors = {
            "images": _images_of_wall(cameras),
            "intrinsics": cameras.intrinsics,
            "cam_to_world": cameras.cam_to_world,
        }
        return {
            n: tensor.expand(self.sizes["batch"], *tensor.shape) for n, tensor in tensors.items()
        }

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        """Return the inverse depths."""
        images = tensors["images"]
        cameras = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *images.shape[-2:])
        return plane_sweep(images, cameras, **self.options, backend=backend).inverse_depth


def _images_of_wall(cameras: Cameras) -> Tensor:
    """Render a wall at about DISTANCE, z = DISTANCE + SLANT x: [V, 3, H, W] in [0, 1]."""
    origins, directions = cameras.rays()
    missing = DISTANCE + SLANT * origins[..., 0] - origins[..., 2]
    along = missing / (directions[..., 2] - SLANT * directions[..., 0])
    points = (origins + along[..., None] * directions)[..., :2]
    uniform, normal = random_numbers(0)
    waves, phases = 6 * normal(3, WAVES, 2), 2 * math.pi * uniform(3, WAVES)
    angles = torch.einsum("vhwi,cni->vcnhw", points, waves) + phases[..., None, None]
    return (0.5 + 0.08 * angles.sin().sum(2)).clamp(0, 1)


def find_cases(options: Mapping[str, Any]) -> list[OpCase]:
    """Make each operator at its size; attention with each of its grids."""
    attention = dict(options["grid_attention"])
    grids = attention.pop("grids")
    sizes = [(scan, options[scan]) for scan in SCANS]
    sizes += [("grid_attention", attention | {"grid": grid}) for grid in grids]
    exact = options["exact"]
    cases = [OpCase(operator, size, exact[operator]) for operator, size in sizes]
    return [*cases, PlaneSweepCase("plane_sweep", options["plane_sweep"], exact["plane_sweep"])]


@dataclass(frozen=True)
class Path:
    """A backend of an operator, with inputs."""

    case: OpCase
    backend: str
    inputs: Tensors  # that require gradients
    weights: Tensor  # the gradient of the output, from a normal distribution

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.case.run(self.inputs, self.backend)

    def forward_backward(self) -> Gradients:
        if not self.case.differentiable:
            return self.forward(), {}
        output = self.case.run(self.inputs, self.backend)
        gradients = torch.autograd.grad(output, list(self.inputs.values()), self.weights)
        return output.detach(), dict(zip(self.inputs, gradients, strict=True))

    def passes(self) -> dict[str, Callable[[], object]]:
        passes = {"forward": self.forward, "forward_backward": self.forward_backward}
        return passes if self.case.differentiable else {"forward": self.forward}

    def seconds(self) -> dict[str, float]:
        """Time each pass once."""
        return {name: seconds_of(run, self.weights.device) for name, run in self.passes().items()}

    def exact(self) -> Gradients:
        """Run the reference in float64 on the CPU, on inputs rounded as this path's are."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        weights = self.weights.cpu().double()
        return Path(self.case, REFERENCE, inputs, weights).forward_backward()

    def errors(self, exact: Gradients) -> Result:
        """Compare the output and the gradient of each input with the exact ones, relative in L2."""
        output, gradients = self.forward_backward()
        return {
            "measured_on": dict(self.case.sizes),
            "forward": relative_l2(output, exact[0]),
            "gradients": {n: relative_l2(gradients[n], true) for n, true in exact[1].items()}
            or None,
        }


def make_path(case: OpCase, backend: str, dtype: torch.dtype, device: torch.device) -> Path:
    """Make a path on the inputs of a case, in `dtype` but for FP32_INPUTS."""
    inputs = {
        name: tensor.to(device, torch.float32 if name in FP32_INPUTS else dtype).requires_grad_()
        for name, tensor in case.tensors().items()
    }
    # The output has the shape and type of the first input.
    first = next(iter(inputs.values()))
    weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
    return Path(case, backend, inputs, weights.to(first))


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, times in seconds. The path "loop" is the
        reference in fp32 on a shorter sequence, its times scaled to the whole; "matmuls" are the
        operator's matrix products by themselves. plane_sweep has neither and no gradients, but its
        reference on all pixels.

    Raises:
        InputError: an unknown precision or device, sizes an operator cannot take.
    """
    device = find_device(options.device)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    check_names("ops.precisions", sizes["precisions"], PRECISIONS)
    results: list[Result] = []
    for case in track(find_cases(sizes), "operators", console=console):
        measurements = make_rows(case, sizes["precisions"], sizes["loop_tokens"], device)
        time_in_rounds(measurements, options.repeats)
        paths = {}
        for timed in measurements:
            row = timed.row
            row |= {name: timed.summary(name) if name in timed.seconds else None for name in PASSES}
            paths[row["path"], row["precision"]] = row
        loop = paths.get((LOOP, "fp32")) or paths.get((REFERENCE, "fp32"))
        for row in paths.values():
            matmuls = paths.get((MATMULS, row["precision"]))
            row["faster_than_loop"] = loop and ratios(loop, row, PASSES)
            row["over_matmuls"] = matmuls and ratios(row, matmuls, PASSES)
        results += paths.values()
    return {"rows": results}


def make_rows(
    case: OpCase, precisions: Iterable[str], loop_tokens: int, device: torch.device
) -> list[Measurement]:
    """Prepare the measurements of one operator: its paths, its bare products, the loop.

    Args:
        precisions: of the inputs.
        loop_tokens: length of the sequence that the loop is timed on.
    """
    rows = []
    for precision in [name for name in precisions if name in case.precisions]:
        dtype = PRECISIONS[precision]
        exact = make_path(case.small, REFERENCE, dtype, device).exact()
        for backend in case.backends:
            if backend in {"cpu", "cuda"} - {device.type}:
                continue
            try:
                errors = make_path(case.small, backend, dtype, device).errors(exact)
            except InputError:  # the operator has no such backend, or it cannot run here
                continue
            path = make_path(case, backend, dtype, device)
            rows.append(_row(case, precision, backend, path.seconds, error=errors))
        if case.products():
            sizes = {"forward": case.products()}
            if case.differentiable:
                sizes["forward_backward"] = with_gradients(case.products())
            groups = {name: products(size, dtype, device) for name, size in sizes.items()}
            rows.append(_row(case, precision, MATMULS, partial(time_products, groups, device)))
    return [*rows, _loop(case, loop_tokens, device)] if case.operator in SCANS else rows


def _loop(case: OpCase, tokens: int, device: torch.device) -> Measurement:
    """Prepare the reference in fp32, which takes one token after the other."""
    small = make_path(case.small, REFERENCE, torch.float32, device)
    length = min(tokens, case.sizes["length"])
    path = make_path(case.resized(length=length), REFERENCE, torch.float32, device)
    scale = case.sizes["length"] / length
    return _row(
        case,
        "fp32",
        LOOP,
        lambda: {name: scale * value for name, value in path.seconds().items()},
        error=small.errors(small.exact()),
        loop_tokens=length,
    )


def _row(case: OpCase, precision: str, path: str, timer: Timer, **costs: Any) -> Measurement:
    row = {"operator": case.name, "sizes": dict(case.sizes), "precision": precision, "path": path}
    row |= {"threads": torch.get_num_threads(), "error": None}
    return Measurement(timer, row | costs)


def tables(results: Result) -> list[Table]:
    """Show each pass: its time, against the sequential loop and bare products; error."""
    rows = results["rows"]
    loop = max((row["loop_tokens"] for row in rows if row["path"] == LOOP), default=0)
    notes = f"{machine_note(results)}\n{NOTES.format(loop=loop)}"
    shown = []
    for name, title in PASSES.items():
        columns = {
            "operator": text("{operator}"),
            "inputs": text("{precision}"),
            "path": text("{path}"),
            "ms": spread(name),
            "loop\n/ path": number(f"faster_than_loop.{name}", "{:.1f}"),
            "path\n/ matmuls": number(f"over_matmuls.{name}", "{:.2f}"),
            "error": error(ERRORS[name]),
        }
        shown.append(make_table(title, columns, [row for row in rows if row[name]], notes, 3))
    return shown


def plot(results: Result) -> Figure:
    """Plot the forward pass, and both passes."""
    exact = "against float64, relative L2"
    labels = {"forward": f"output {exact}", "forward_backward": f"worst gradient {exact}"}
    errors = {name: (label, ERRORS[name]) for name, label in labels.items()}
    rows = [row for row in results["rows"] if row["error"]]
    return time_against_error(rows, errors, backend="path", case="operator")
