"""Every backend of the renderer, with all culling and without each kind: seconds and error."""

from dataclasses import fields
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

from asysplat.rendering import render
from asysplat.rendering.interface import Culling, without_culling
from asysplat.scene import Cameras, Gaussians
from benchmarks import timing
from benchmarks.compare import ERROR, TIME, TrackedMetrics
from benchmarks.options import CPU, check_names
from benchmarks.plot import time_against_error
from benchmarks.scenes import SCENES, SMALLER, Scene
from benchmarks.table import (
    error_column,
    machine_note,
    make_table,
    median_iqr_column,
    number_column,
    text_column,
)
from benchmarks.timing import Measurement, Result, device_time, relative_l2

TRACKED = TrackedMetrics(
    names=("scene", "backend", "without"),
    must_match=("gaussians", "views", "height", "width", "error.measured_on"),
    kinds=dict.fromkeys(("forward", "backward"), TIME)
    | dict.fromkeys(("error.image_p99", "error.image_max", "error.gradients"), ERROR),
)
CULLING = tuple(field.name for field in fields(Culling))
FIELDS = tuple(field.name for field in fields(Gaussians))
FLIP = 1e-4  # more than rounding alone changes a color; a flipped cut-off changes up to 1/255
PASSES = ("forward", "backward")


class Backend(NamedTuple):
    """A backend of the renderer."""

    name: str
    device: torch.device = CPU  # device of its tensors
    culling: tuple[str, ...] = ()  # kinds of culling that can be switched off


Inputs = tuple[Gaussians, Cameras, Tensor]  # see `prepare_inputs`


class Outputs(NamedTuple):
    """The results of a forward and a backward pass."""

    image: Tensor  # [V, 3, H, W]
    gradients: tuple[Tensor, ...]  # in the order of FIELDS
    seconds: dict[str, float]  # durations of "forward" and "backward"
    stats: dict[str, int]


def find_backends() -> list[Backend]:
    """List the reference, then the fast backends that this machine can run."""
    backends = [Backend("reference"), Backend("cpu", culling=CULLING)]
    if torch.cuda.is_available():
        without_rows = tuple(name for name in CULLING if name != "rows")
        backends.append(Backend("cuda", torch.device("cuda"), without_rows))
    return backends


def prepare_inputs(
    scene: Scene, device: torch.device = CPU, ignored: Tensor | None = None
) -> Inputs:
    """Make the inputs of `run_passes` on a device.

    Returns:
        Gaussians that require gradients, cameras, and the gradient of the image [V, 3, H, W]: drawn
        from a normal distribution, the same at every call, and 0 at the pixels `ignored`
        [V, H, W].
    """
    gaussians, cameras = (part.to(device) for part in scene)
    size = (cameras.num_views, 3, cameras.height, cameras.width)
    weights = torch.randn(size, generator=torch.Generator().manual_seed(1))
    if ignored is not None:
        weights = weights * ~ignored[:, None]
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    return leaves, cameras, weights.to(gaussians.means)


def run_passes(backend: Backend, inputs: Inputs, *off: str) -> Outputs:
    """Render without background, with the kinds of culling `off` switched off; differentiate."""
    gaussians, cameras, weights = inputs
    leaves = [getattr(gaussians, name) for name in FIELDS]
    start = device_time(backend.device)
    with without_culling(*off):
        out = render(gaussians, cameras, backend=backend.name, depth=False)
    middle = device_time(backend.device)
    gradients = torch.autograd.grad(out.image, leaves, weights)
    seconds = {"forward": middle - start, "backward": device_time(backend.device) - middle}
    return Outputs(out.image.detach(), gradients, seconds, dict(out.stats))


def run_exact(scene: Scene, ignored: Tensor | None = None) -> Outputs:
    """Run both passes of the reference in float64."""
    exact = tuple(part.to(torch.float64) for part in scene)
    return run_passes(Backend("reference"), prepare_inputs(exact, ignored=ignored))


def find_flips(outputs: Outputs, exact: Outputs) -> Tensor:
    """Return a mask [V, H, W] of the pixels where rounding flipped a decision at a cut-off."""
    return ((outputs.image.cpu().double() - exact.image).abs() > FLIP).any(1)


def measure_errors(outputs: Outputs, exact: Outputs, ignored: Tensor) -> Result:
    """Compare image and gradients with exact ones that leave out the pixels `ignored` [V, H, W].

    Returns:
        "flipped": fraction of the pixels that are ignored; "image_max" and "image_p99": largest
        difference of the image, and its 99th percentile; "gradients": relative L2 errors.
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
    """Time every backend on the scenes in `options.scenes`, `options.repeats` times.

    Returns:
        "rows": one for each scene, backend and kind of culling that is off, with times in seconds.
    """
    names = list(SCENES) if options.scenes == "all" else options.scenes
    check_names("scenes", names, SCENES)
    names = track(names, "scenes", console=console)
    return {"rows": [row for name in names for row in _measure_scene(name, options.repeats)]}


def _measure_scene(name: str, repeats: int) -> list[Result]:
    backends = find_backends()
    scene = SCENES[name]()
    small = SMALLER[name]() if name in SMALLER else scene
    # Where rounding flips a decision at a cut-off, results differ by more than rounding.
    exact = run_exact(small)
    fast = [run_passes(b, prepare_inputs(small, b.device)) for b in backends]
    ignored = torch.stack([find_flips(outputs, exact) for outputs in fast]).any(0)
    exact = run_exact(small, ignored)
    measurements = []
    for backend in backends:
        inputs = prepare_inputs(scene, backend.device)
        small_inputs = prepare_inputs(small, backend.device, ignored)
        for off in (None, *backend.culling):
            kinds = [] if off is None else [off]
            run_once = partial(run_passes, backend, inputs, *kinds)
            error = measure_errors(run_passes(backend, small_inputs, *kinds), exact, ignored)
            row = {"scene": name, "backend": backend.name, "without": off, **_sizes(scene)}
            row["error"] = {"measured_on": _sizes(small), **error}
            row["stats"] = run_once().stats
            measurements.append(Measurement(lambda run_once=run_once: run_once().seconds, row))
    timing.time_in_rounds(measurements, repeats)
    return [m.row | {name: m.summarize(name) for name in PASSES} for m in measurements]


def _sizes(scene: Scene) -> dict[str, int]:
    gaussians, cameras = scene
    sizes = {"gaussians": gaussians.num_gaussians, "views": cameras.num_views}
    return sizes | {"height": cameras.height, "width": cameras.width}


def tables(results: Result) -> list[Table]:
    """Show every backend with all culling, and without each kind."""
    notes = (
        f"{machine_note(results)}; *: errors of a smaller scene of the same kind;\n"
        "errors: without the pixels where rounding in any backend flips a decision at a cut-off"
    )
    columns = {
        "scene": text_column("{scene}"),
        "backend": lambda r: f"  no {r['without']} culling" if r["without"] else r["backend"],
        "forward\nms": median_iqr_column("forward"),
        "backward\nms": median_iqr_column("backward"),
        "image\np99": error_column("error.image_p99"),
        "image\nmax": error_column("error.image_max"),
        "flips\n1e-6": number_column("error.flipped", "{:.0f}", unit=1e-6),
        "gradients\nworst": error_column("error.gradients"),
    }
    title = "Every backend, and without one kind of culling"
    return [make_table(title, columns, results["rows"], notes, names=2)]


def plot(results: Result) -> Figure:
    """Plot time against error of both passes of every backend, with all culling."""
    labels = {
        "forward": ("image against float64, 99th percentile", "error.image_p99"),
        "backward": ("worst gradient against float64, relative L2", "error.gradients"),
    }
    rows = [row for row in results["rows"] if row["without"] is None]
    return time_against_error(rows, labels)
