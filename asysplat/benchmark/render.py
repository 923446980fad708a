"""Every backend of the renderer, and every culling switched off: seconds, memory, error."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat.benchmark.compare import ERROR, TIME, Watched
from asysplat.benchmark.options import CPU
from asysplat.benchmark.plot import time_against_error
from asysplat.benchmark.scenes import SCENES, SMALLER, Scene, find_scenes
from asysplat.benchmark.table import error, machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import (
    Measurement,
    Result,
    now,
    ratios,
    relative_l2,
    rise_gb,
    time_in_rounds,
)
from asysplat.ops.simd.threads import time_kernels
from asysplat.rendering import Culling, render
from asysplat.scene import Cameras, Gaussians

WATCHED = Watched(
    names=("scene", "backend", "without"),
    alike=("gaussians", "views", "height", "width", "error.measured_on"),
    kinds=dict.fromkeys(("forward", "backward"), TIME)
    | dict.fromkeys(("error.image_p99", "error.image_max", "error.gradients"), ERROR),
)
CULLING = tuple(field.name for field in fields(Culling))
CUDA_CULLING = tuple(name for name in CULLING if name != "rows")
FIELDS = tuple(field.name for field in fields(Gaussians))
FLIP = 1e-4  # a difference that rounding alone does not make; a flip makes up to 1/255
PASSES = ("forward", "backward")


class Backend(NamedTuple):
    """A renderer."""

    name: str
    device: torch.device = CPU  # of its tensors
    culling: tuple[str, ...] = ()  # names of the culling that can be switched off


class Inputs(NamedTuple):
    """A scene on the device of a backend."""

    gaussians: Gaussians  # leaves that require gradients
    cameras: Cameras
    weights: Tensor  # [V, 3, H, W] the gradient of the image, from a normal distribution


class Outputs(NamedTuple):
    """The results of both passes."""

    image: Tensor  # [V, 3, H, W]
    gradients: tuple[Tensor, ...]  # of each of FIELDS
    seconds: dict[str, float]  # of "forward" and "backward"
    kernels: dict[str, float]  # seconds of each kernel, of the cpu backend
    stats: dict[str, int]


def find_backends() -> list[Backend]:
    """List the reference, then the fast backends that can run here."""
    backends = [Backend("reference"), Backend("cpu", culling=CULLING)]
    if torch.cuda.is_available():
        backends.append(Backend("cuda", torch.device("cuda"), CUDA_CULLING))
    return backends


def prepare(scene: Scene, device: torch.device = CPU, ignored: Tensor | None = None) -> Inputs:
    """Move a scene to a device.

    The weights are the same at every call, but for 0 at the pixels `ignored`, [V, H, W].
    """
    gaussians, cameras = (part.to(device) for part in scene)
    size = (cameras.num_views, 3, cameras.height, cameras.width)
    weights = torch.randn(size, generator=torch.Generator().manual_seed(1))
    if ignored is not None:
        weights = weights * ~ignored[:, None]
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    return Inputs(leaves, cameras, weights.to(gaussians.means))


def run(backend: Backend, culling: Culling, inputs: Inputs) -> Outputs:
    """Render without background, and compute the gradients."""
    gaussians, cameras, weights = inputs
    leaves = [getattr(gaussians, name) for name in FIELDS]
    with time_kernels() as kernels:
        start = now(backend.device)
        out = render(gaussians, cameras, backend=backend.name, culling=culling, depth=False)
        middle = now(backend.device)
        gradients = torch.autograd.grad(out.image, leaves, weights)
        seconds = {"forward": middle - start, "backward": now(backend.device) - middle}
    return Outputs(out.image.detach(), gradients, seconds, kernels, out.stats)


def run_exact(scene: Scene, ignored: Tensor | None = None) -> Outputs:
    """Render the scene by the reference in float64."""
    exact = tuple(part.to(torch.float64) for part in scene)
    return run(Backend("reference"), Culling(), prepare(exact, ignored=ignored))


def flips(outputs: Outputs, exact: Outputs) -> Tensor:
    """Find the pixels [V, H, W] at which rounding decided otherwise at a cut-off."""
    return ((outputs.image.cpu().double() - exact.image).abs() > FLIP).any(1)


def errors(outputs: Outputs, exact: Outputs, ignored: Tensor) -> Result:
    """Compare images and gradients outside the pixels `ignored`, [V, H, W].

    Returns:
        "flipped": the share of the pixels ignored; "image_max" and "image_p99": the largest
        difference and its 99th percentile; "gradients": the relative L2 error of each of FIELDS.
    """
    differences = (outputs.image.cpu().double() - exact.image).abs() * ~ignored[:, None]
    gradients = map(relative_l2, outputs.gradients, exact.gradients)
    return {
        "flipped": ignored.double().mean().item(),
        "image_max": differences.max().item(),
        "image_p99": float(np.percentile(differences.numpy(), 99)),
        "gradients": dict(zip(FIELDS, gradients, strict=True)),
    }


def measure(options: DictConfig, console: Console) -> Result:
    """Time every backend on the scenes `options.scenes`, `options.repeats` times.

    Returns:
        "rows": one for each scene, backend and culling that is off, times in seconds.

    Raises:
        InputError: an unknown scene.
    """
    rows: list[Result] = []
    for name in track(find_scenes(options.scenes), "scenes", console=console):
        rows += _measure_scene(name, options.repeats)
    return {"rows": rows}


def _measure_scene(name: str, repeats: int) -> list[Result]:
    backends = find_backends()
    scene = SCENES[name]()
    small = SMALLER[name]() if name in SMALLER else scene
    # Where the rounding of any backend decides about a cut-off, more than rounding differs.
    exact = run_exact(small)
    fast = [run(b, Culling(), prepare(small, b.device)) for b in backends]
    ignored = torch.stack([flips(outputs, exact) for outputs in fast]).any(0)
    exact = run_exact(small, ignored)
    measurements = []
    for backend in backends:
        inputs = prepare(scene, backend.device)
        small_inputs = prepare(small, backend.device, ignored)
        for off in (None, *backend.culling):
            culling = replace(Culling(), **{off: False}) if off else Culling()
            run_once = partial(run, backend, culling, inputs)
            error = errors(run(backend, culling, small_inputs), exact, ignored)
            row = {"scene": name, "backend": backend.name, "without": off, **_sizes(scene)}
            row |= {
                "threads": torch.get_num_threads(),
                "error": {"measured_on": _sizes(small), **error},
                "peak_gb": rise_gb(run_once, backend.device),
            }
            measurements.append(Measurement(partial(_seconds, run_once, row), row))
    time_in_rounds(measurements, repeats)
    for timed in measurements:
        row = timed.row
        row |= {name: timed.summary(name) for name in PASSES}
        row["faster_than_reference"] = ratios(measurements[0].row, row, PASSES)
        if row["backend"] == "cpu":
            kernels = [name for name in timed.seconds if name not in PASSES]
            row["stages"] = {name: timed.summary(name) for name in kernels}
    return [timed.row for timed in measurements]


def _sizes(scene: Scene) -> dict[str, int]:
    gaussians, cameras = scene
    sizes = {"gaussians": gaussians.num_gaussians, "views": cameras.num_views}
    return sizes | {"height": cameras.height, "width": cameras.width}


def _seconds(run_once: Callable[[], Outputs], row: Result) -> dict[str, float]:
    """Time both passes and the kernels in them; add the counts to the row."""
    outputs = run_once()
    row["stats"] = outputs.stats
    return outputs.seconds | outputs.kernels


def tables(results: Result) -> list[Table]:
    """Show all rows, and the kernels of the cpu backend."""
    rows = results["rows"]
    ours = [row for row in rows if row["backend"] == "cpu" and row["without"] is None]
    notes = (
        f"{machine_note(results)}; *: errors of a smaller scene of the same make;\n"
        "errors outside the pixels where some backend's rounding decides otherwise at a cut-off"
    )
    columns = {
        "scene": text("{scene}"),
        "backend": lambda row: (
            f"  no {row['without']} culling" if row["without"] else row["backend"]
        ),
        "forward\nms": spread("forward"),
        "backward\nms": spread("backward"),
        "memory\nMB": number("peak_gb", "{:.0f}", unit=1e-3),
        "image\np99": error("error.image_p99"),
        "image\nmax": error("error.image_max"),
        "flips\n1e-6": number("error.flipped", "{:.0f}", unit=1e-6),
        "gradients\nworst": error("error.gradients"),
    }
    kernels = ours[0]["stages"] if ours else ()
    passes = {name.replace("_", "\n"): spread(f"stages.{name}") for name in kernels}
    return [
        make_table("Every backend, and without one kind of culling", columns, rows, notes, names=2),
        make_table("Kernels of the cpu backend, ms", {"scene": text("{scene}"), **passes}, ours),
    ]


def plot(results: Result) -> Figure:
    """Plot the forward and the backward pass of every backend with all its culling."""
    labels = {
        "forward": ("image against float64, 99th percentile", "error.image_p99"),
        "backward": ("worst gradient against float64, relative L2", "error.gradients"),
    }
    rows = [row for row in results["rows"] if row["without"] is None]
    return time_against_error(rows, labels, backend="backend", case="scene")
