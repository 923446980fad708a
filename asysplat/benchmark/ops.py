"""Every path of the operators: time beside the sequential loop and bare products; error."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat import ops
from asysplat.benchmark import products, timing
from asysplat.benchmark.compare import ERROR, TIME, Watched
from asysplat.benchmark.options import PRECISIONS, check_names, find_device
from asysplat.benchmark.scenes import DISTANCE, FOCAL, camera_at_origin, on_an_arc, random_numbers
from asysplat.benchmark.table import error, machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, relative_l2
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
    # A Mamba2 layer's scan, of one direction
    "ssd": {"x": "batch length heads head_dim", "dt": "batch length heads", "A": "heads"}
    | {**dict.fromkeys("BC", "batch length state"), "D": "heads"},
    # A MambaVision layer's scan: each image is a sequence
    "selective_scan": {**dict.fromkeys(("x", "dt"), "batch length channels"), "A": "channels state"}
    | {**dict.fromkeys("BC", "batch length state"), "D": "channels"},
    # One attention layer; grid 1 is full attention
    "grid_attention": dict.fromkeys("qkv", "batch views height width heads head_dim"),
}
PRODUCTS = {"ssd": products.ssd_sizes, "grid_attention": products.grid_attention_sizes}
# The plane sweep's scene: cameras on an arc before a slanted wall with a texture.
SLANT = 0.3  # by which the wall is farther away, a unit to the right
WAVES = 20  # of each color

Tensors = dict[str, Tensor]


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

    def resized(self, sizes: Mapping[str, int]) -> "OpCase":
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

    def products(self) -> list[products.Size]:
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
        # A wall at about DISTANCE, z = DISTANCE + SLANT x
        origins, directions = cameras.rays()
        missing = DISTANCE + SLANT * origins[..., 0] - origins[..., 2]
        along = missing / (directions[..., 2] - SLANT * directions[..., 0])
        points = (origins + along[..., None] * directions)[..., :2]
        uniform, normal = random_numbers(0)
        waves, phases = 6 * normal(3, WAVES, 2), 2 * math.pi * uniform(3, WAVES)
        angles = torch.einsum("vhwi,cni->vcnhw", points, waves) + phases[..., None, None]
        images = (0.5 + 0.08 * angles.sin().sum(2)).clamp(0, 1)
        tensors = {"images": images, "intrinsics": cameras.intrinsics}
        tensors["cam_to_world"] = cameras.cam_to_world
        return {n: t.expand(self.sizes["batch"], *t.shape) for n, t in tensors.items()}

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        """Return the inverse depths."""
        images = tensors["images"]
        cameras = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *images.shape[-2:])
        return plane_sweep(images, cameras, **self.options, backend=backend).inverse_depth


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

    def forward_backward(self) -> tuple[Tensor, Tensors]:
        """Return the output, and the gradient of each input."""
        if not self.case.differentiable:
            return self.forward(), {}
        output = self.case.run(self.inputs, self.backend)
        gradients = torch.autograd.grad(output, list(self.inputs.values()), self.weights)
        return output.detach(), dict(zip(self.inputs, gradients, strict=True))

    def seconds(self) -> dict[str, float]:
        """Time each pass once."""
        names = list(PASSES)[: 2 if self.case.differentiable else 1]
        return {n: timing.seconds_of(getattr(self, n), self.weights.device) for n in names}

    def exact(self) -> tuple[Tensor, Tensors]:
        """Run the reference in float64 on the CPU, on inputs rounded as this path's are."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        weights = self.weights.cpu().double()
        return Path(self.case, REFERENCE, inputs, weights).forward_backward()

    def errors(self, exact: tuple[Tensor, Tensors]) -> Result:
        """Compare the output and the gradient of each input with the exact ones, relative in L2."""
        output, gradients = self.forward_backward()
        errors = {name: relative_l2(gradients[name], true) for name, true in exact[1].items()}
        sizes, forward = dict(self.case.sizes), relative_l2(output, exact[0])
        return {"measured_on": sizes, "forward": forward, "gradients": errors or None}


def make_path(case: OpCase, backend: str, dtype: torch.dtype, device: torch.device) -> Path:
    """Make a path on the inputs of a case, in `dtype` but for FP32_INPUTS."""
    inputs = {}
    for name, tensor in case.tensors().items():
        own = torch.float32 if name in FP32_INPUTS else dtype
        inputs[name] = tensor.to(device, own).requires_grad_()
    first = next(iter(inputs.values()))  # the output has its shape and type
    weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
    return Path(case, backend, inputs, weights.to(first))


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, times in seconds. The path "loop" is the
        reference in fp32 on a shorter sequence, its times scaled to the whole; "matmuls" are the
        operator's matrix products by themselves. plane_sweep has neither and no gradients, but its
        reference on all pixels.
    """
    device = find_device(options.device)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    check_names("ops.precisions", sizes["precisions"], PRECISIONS)
    exact, grids = sizes["exact"], sizes["grid_attention"].pop("grids")
    cases = [OpCase(scan, sizes[scan], exact[scan]) for scan in SCANS]
    attention = OpCase("grid_attention", sizes["grid_attention"], exact["grid_attention"])
    cases += [attention.resized({"grid": grid}) for grid in grids]
    cases.append(PlaneSweepCase("plane_sweep", sizes["plane_sweep"], exact["plane_sweep"]))
    results: list[Result] = []
    for case in track(cases, "operators", console=console):
        measurements = make_rows(case, sizes["precisions"], sizes["loop_tokens"], device)
        timing.time_in_rounds(measurements, options.repeats)
        paths = {}
        for timed in measurements:
            row = timed.row
            row |= {name: timed.summary(name) if name in timed.seconds else None for name in PASSES}
            paths[row["path"], row["precision"]] = row
        loop = paths.get((LOOP, "fp32")) or paths.get((REFERENCE, "fp32"))
        for row in paths.values():
            matmuls = paths.get((MATMULS, row["precision"]))
            row["faster_than_loop"] = loop and _ratios(loop, row)
            row["over_matmuls"] = matmuls and _ratios(row, matmuls)
        results += paths.values()
    return {"rows": results}


def _ratios(one: Result, other: Result) -> dict[str, float | None]:
    both = [name for name in PASSES if one[name] and other[name]]
    medians = {name: one[name]["median"] / other[name]["median"] for name in both}
    return dict.fromkeys(PASSES) | medians


def make_rows(
    case: OpCase, precisions: Iterable[str], loop_tokens: int, device: torch.device
) -> list[Measurement]:
    """Prepare the measurements of one operator: its paths, its bare products, the loop.

    `precisions` are those of the inputs; the loop is timed on `loop_tokens`.
    """
    rows, small = [], case.resized(case.exact)

    def add(precision: str, path: str, timer: timing.Timer, **costs: Any) -> None:
        names = {"operator": case.name, "sizes": dict(case.sizes), "precision": precision}
        rows.append(Measurement(timer, names | {"path": path, "error": None} | costs))

    for precision in [name for name in precisions if name in case.precisions]:
        dtype = PRECISIONS[precision]
        exact = make_path(small, REFERENCE, dtype, device).exact()
        for backend in case.backends:
            if backend in {"cpu", "cuda"} - {device.type}:
                continue
            try:
                errors = make_path(small, backend, dtype, device).errors(exact)
            except InputError:  # the operator has no such backend, or it cannot run here
                continue
            path = make_path(case, backend, dtype, device)
            add(precision, backend, path.seconds, error=errors)
        if sizes := case.products():
            sizes = {"forward": sizes, "forward_backward": products.with_gradients(sizes)}
            groups = {n: products.products(size, dtype, device) for n, size in sizes.items()}
            add(precision, MATMULS, partial(products.time_products, groups, device))
    if case.operator in SCANS:  # the reference in fp32, which takes one token after the other
        reference = make_path(small, REFERENCE, torch.float32, device)
        length = min(loop_tokens, case.sizes["length"])
        path = make_path(case.resized({"length": length}), REFERENCE, torch.float32, device)
        scale = case.sizes["length"] / length
        errors = reference.errors(reference.exact())

        def scaled() -> dict[str, float]:
            return {name: scale * value for name, value in path.seconds().items()}

        add("fp32", LOOP, scaled, error=errors, loop_tokens=length)
    return rows


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
