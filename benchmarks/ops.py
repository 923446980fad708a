"""Every backend of the operators: time, speedup over the sequential loop, and error."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat import ops
from asysplat.errors import InputError
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.runs.machine import find_device
from asysplat.scene import Cameras
from benchmarks import timing
from benchmarks.compare import ERROR, TIME, TrackedMetrics
from benchmarks.options import PRECISIONS, check_names
from benchmarks.scenes import DISTANCE, FOCAL, camera_at_origin, place_on_arc, random_numbers
from benchmarks.table import (
    error_column,
    machine_note,
    make_table,
    median_iqr_column,
    number_column,
    text_column,
)
from benchmarks.timing import Measurement, Result, relative_l2

PASSES = {"forward": "Forward", "forward_backward": "Forward and backward"}
ERRORS = {"forward": "error.forward", "forward_backward": "error.gradients"}
TRACKED = TrackedMetrics(
    names=("operator", "precision", "path"),
    must_match=("sizes", "loop_tokens", "error.measured_on"),
    kinds=dict.fromkeys(PASSES, TIME) | dict.fromkeys(ERRORS.values(), ERROR),
)
LOOP, REFERENCE = "loop", "reference"
NOTES = """\
loop: reference.py in fp32 on {loop} tokens, its times scaled to the whole sequence; for \
plane_sweep, the reference at full size
error: relative L2 error against the reference in float64; *: measured on smaller inputs"""

STEPS = (1e-3, 1e-1)  # range of dt in an untrained network
SCANS = ("ssd", "selective_scan")
ATTENTION, PLANE_SWEEP, CONVOLUTION = "grid_attention", "plane_sweep", "conv_silu"
FP32_INPUTS = ("dt", "A", "D", "weight", "bias")  # inputs that stay fp32
# The shape of each input, in the order in which they are drawn.
SHAPES = {
    # The scan of a Mamba2 layer, in one direction
    "ssd": {"x": "batch length heads head_dim", "dt": "batch length heads", "A": "heads"}
    | {**dict.fromkeys("BC", "batch length state"), "D": "heads"},
    # The scan of a MambaVision layer: each image is a sequence
    "selective_scan": {**dict.fromkeys(("x", "dt"), "batch length channels"), "A": "channels state"}
    | {**dict.fromkeys("BC", "batch length state"), "D": "channels"},
    # One attention layer; grid 1 is full attention
    ATTENTION: dict.fromkeys("qkv", "batch views height width heads head_dim"),
    # The convolution of a Mamba2 layer, in one direction
    CONVOLUTION: {"tokens": "batch length channels", "weight": "channels size", "bias": "channels"},
}
# The backend measured beside "cpu" or "cuda", and the sizes that are arguments of the operator.
BACKENDS = dict.fromkeys(SCANS, "chunked") | {ATTENTION: "sdpa", PLANE_SWEEP: REFERENCE}
BACKENDS[CONVOLUTION] = REFERENCE
ARGUMENTS = dict.fromkeys(SCANS, ()) | {ATTENTION: ("grid",)}
ARGUMENTS |= {PLANE_SWEEP: ("planes", "neighbors"), CONVOLUTION: ("before",)}
# The scene of the plane sweep: cameras on an arc in front of a slanted, textured wall.
SLANT = 0.3  # increase of the wall's depth with each unit to the right
WAVES = 20  # sine waves in each color channel of the texture

Tensors = dict[str, Tensor]
Sizes = Mapping[str, int]  # sizes of the inputs, named as in SHAPES, and arguments of the operator


def make_inputs(operator: str, sizes: Sizes) -> Tensors:
    """Make the inputs of an operator in float64; the same numbers at every call."""
    if operator == PLANE_SWEEP:
        names = ("batch", "views", "height", "width")
        return _make_plane_sweep_inputs(*(sizes[name] for name in names))
    uniform, normal = random_numbers(0)
    tensors = {}
    for name, sides in SHAPES[operator].items():
        shape = [sizes[side] for side in sides.split()]
        if name == "dt":  # log-uniform
            low, high = map(math.log, STEPS)
            tensors[name] = (low + (high - low) * uniform(shape)).exp()
        elif name != "A":
            tensors[name] = normal(shape)
        elif operator == "ssd":
            tensors[name] = -1 - 15 * uniform(shape)
        else:
            states = torch.arange(1.0, sizes["state"] + 1, dtype=torch.float64)
            tensors[name] = -states.repeat(sizes["channels"], 1)
    return tensors


def _make_plane_sweep_inputs(batch: int, views: int, height: int, width: int) -> Tensors:
    """Make images of the wall z = DISTANCE + SLANT x, and their cameras."""
    camera = camera_at_origin(FOCAL * width, height, width)
    cameras = place_on_arc(camera, views).to(torch.float64)
    origins, directions = cameras.rays()
    offsets = DISTANCE + SLANT * origins[..., 0] - origins[..., 2]  # from the wall, along z
    distances = offsets / (directions[..., 2] - SLANT * directions[..., 0])
    points = (origins + distances[..., None] * directions)[..., :2]
    uniform, normal = random_numbers(0)
    waves, phases = 6 * normal(3, WAVES, 2), 2 * math.pi * uniform(3, WAVES)
    angles = torch.einsum("vhwi,cni->vcnhw", points, waves) + phases[..., None, None]
    images = (0.5 + 0.08 * angles.sin().sum(2)).clamp(0, 1)
    tensors = {"images": images, "intrinsics": cameras.intrinsics}
    tensors["cam_to_world"] = cameras.cam_to_world
    return {name: tensor.expand(batch, *tensor.shape) for name, tensor in tensors.items()}


@dataclass(frozen=True)
class OperatorPath:
    """A backend of an operator, and inputs to run it on."""

    operator: str  # name in `asysplat.ops`
    sizes: Sizes
    backend: str
    inputs: Tensors  # each requires a gradient
    weights: Tensor  # gradient of the output

    def run(self) -> Tensor:
        """Return the output, for a plane sweep its inverse depths."""
        options = {name: self.sizes[name] for name in ARGUMENTS[self.operator]}
        options["backend"] = self.backend
        if self.operator != PLANE_SWEEP:
            return getattr(ops, self.operator)(**self.inputs, **options)
        images, *cameras = self.inputs.values()
        return plane_sweep(images, Cameras(*cameras, *images.shape[-2:]), **options).inverse_depth

    @torch.no_grad()
    def forward(self) -> Tensor:
        return self.run()

    def forward_backward(self) -> tuple[Tensor, Tensors]:
        """Return the output, and the gradient of each input; a plane sweep has no gradients."""
        if self.operator == PLANE_SWEEP:
            return self.forward(), {}
        output = self.run()
        gradients = torch.autograd.grad(output, list(self.inputs.values()), self.weights)
        return output.detach(), dict(zip(self.inputs, gradients, strict=True))

    def time_passes(self) -> dict[str, float]:
        """Run each pass once; return its seconds."""
        names = ("forward",) if self.operator == PLANE_SWEEP else PASSES
        return {n: timing.measure_run(getattr(self, n), self.weights.device) for n in names}

    def run_exact(self) -> tuple[Tensor, Tensors]:
        """Run the reference in float64 on the CPU, on the same numbers as this path."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        weights = self.weights.cpu().double()
        exact = OperatorPath(self.operator, self.sizes, REFERENCE, inputs, weights)
        return exact.forward_backward()

    def measure_errors(self, exact: tuple[Tensor, Tensors]) -> Result:
        """Return the relative L2 errors of the output and of the gradient of each input."""
        output, gradients = self.forward_backward()
        errors = {name: relative_l2(gradients[name], true) for name, true in exact[1].items()}
        forward = relative_l2(output, exact[0])
        return {"measured_on": dict(self.sizes), "forward": forward, "gradients": errors or None}


def make_path(
    operator: str, sizes: Sizes, backend: str, dtype: torch.dtype, device: torch.device
) -> OperatorPath:
    """Make a path with inputs in `dtype`, except for FP32_INPUTS; the same at every call."""
    inputs = {}
    for name, tensor in make_inputs(operator, sizes).items():
        input_dtype = torch.float32 if name in FP32_INPUTS else dtype
        inputs[name] = tensor.to(device, input_dtype).requires_grad_()
    first = next(iter(inputs.values()))  # has the shape and type of the output
    weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
    return OperatorPath(operator, sizes, backend, inputs, weights.to(first))


def measure(options: DictConfig, console: Console) -> Result:
    """Time every path of every operator, `options.repeats` times, at the sizes in `options.ops`.

    Returns:
        "rows": one for each operator, precision and path, with times in seconds. The path "loop" of
        a scan is the reference in fp32 on a shorter sequence, its times scaled to the whole one.
        plane_sweep has the reference at full size instead, and no gradients.
    """
    device = find_device(options.device)
    sizes = OmegaConf.to_container(options.ops, resolve=True)
    check_names("ops.precisions", sizes["precisions"], PRECISIONS)
    grids = sizes[ATTENTION].pop("grids")
    cases = [(scan, sizes[scan]) for scan in SCANS]
    cases += [(ATTENTION, sizes[ATTENTION] | {"grid": grid}) for grid in grids]
    cases.append((PLANE_SWEEP, sizes[PLANE_SWEEP]))
    results: list[Result] = []
    for operator, case_sizes in track(cases, "operators", console=console):
        exact = case_sizes | sizes["exact"][operator]
        tokens, precisions = sizes["loop_tokens"], sizes["precisions"]
        measurements = [*make_measurements(operator, case_sizes, exact, precisions, tokens, device)]
        timing.time_in_rounds(measurements, options.repeats)
        rows = [
            timed.row | {n: timed.summarize(n) if n in timed.seconds else None for n in PASSES}
            for timed in measurements
        ]
        slow = (LOOP, REFERENCE)
        loop = next((r for r in rows if r["path"] in slow and r["precision"] == "fp32"), None)
        for row in rows:
            row["faster_than_loop"] = loop and {
                name: row[name] and loop[name]["median"] / row[name]["median"] for name in PASSES
            }
        results += rows
    return {"rows": results}


def make_measurements(
    operator: str,
    sizes: Sizes,
    exact_sizes: Sizes,
    precisions: list[str],
    loop_tokens: int,
    device: torch.device,
) -> Iterator[Measurement]:
    """Yield the measurements of one operator: its backends, then the sequential loop of a scan.

    Args:
        sizes: sizes at which time is measured.
        exact_sizes: sizes at which errors are measured.
        precisions: precisions of the inputs; a plane sweep has only fp32.
        loop_tokens: length of the sequence on which the loop is timed.
    """
    name = f"{operator}/{sizes['grid']}" if "grid" in sizes else operator
    row = {"operator": name, "sizes": dict(sizes)}
    for precision in precisions:
        if operator == PLANE_SWEEP and precision != "fp32":
            continue
        dtype = PRECISIONS[precision]
        exact = make_path(operator, exact_sizes, REFERENCE, dtype, device).run_exact()
        for backend in (BACKENDS[operator], device.type):
            try:
                small = make_path(operator, exact_sizes, backend, dtype, device)
                errors = small.measure_errors(exact)
            except InputError:  # the operator has no such backend, or it cannot run here
                continue
            path = make_path(operator, sizes, backend, dtype, device)
            values = {"precision": precision, "path": backend, "error": errors}
            yield Measurement(path.time_passes, row | values)
    if operator in SCANS:  # the reference processes one token after another
        small = make_path(operator, exact_sizes, REFERENCE, torch.float32, device)
        length = min(loop_tokens, sizes["length"])
        path = make_path(operator, sizes | {"length": length}, REFERENCE, torch.float32, device)

        def time_loop() -> dict[str, float]:
            scale = sizes["length"] / length
            return {name: scale * value for name, value in path.time_passes().items()}

        errors = small.measure_errors(small.run_exact())
        values = {"precision": "fp32", "path": LOOP, "error": errors, "loop_tokens": length}
        yield Measurement(time_loop, row | values)


def tables(results: Result) -> list[Table]:
    """Show the time, the speedup over the sequential loop, and the error of each pass."""
    rows = results["rows"]
    loop = max((row["loop_tokens"] for row in rows if row["path"] == LOOP), default=0)
    notes = f"{machine_note(results)}\n{NOTES.format(loop=loop)}"
    shown = []
    for name, title in PASSES.items():
        columns = {
            "operator": text_column("{operator}"),
            "inputs": text_column("{precision}"),
            "path": text_column("{path}"),
            "ms": median_iqr_column(name),
            "loop\n/ path": number_column(f"faster_than_loop.{name}", "{:.1f}"),
            "error": error_column(ERRORS[name]),
        }
        shown.append(make_table(title, columns, [row for row in rows if row[name]], notes, 3))
    return shown
