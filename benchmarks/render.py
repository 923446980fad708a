"""Every backend of the renderer, and every culling switched off: seconds, memory, error."""

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
from benchmarks.compare import ERROR, TIME, Watched
from benchmarks.options import CPU, check_names
from benchmarks.plot import time_against_error
from benchmarks.scenes import SCENES, SMALLER, Scene
from benchmarks.table import error, machine_note, make_table, median_iqr_column, number, text
from benchmarks.timing import Measurement, Result, device_time, relative_l2

WATCHED = Watched(
    names=("scene", "backend", "without"),
    alike=("gaussians", "views", "height", "width", "error.measured_on"),
    kinds=dict.fromkeys(("forward", "backward"), TIME)
    | dict.fromkeys(("error.image_p99", "error.image_max", "error.gradients"), ERROR),
)
CULLING = tuple(field.name for field in fields(Culling))
FIELDS = tuple(field.name for field in fields(Gaussians))
FLIP = 1e-4  # a difference that rounding alone does not make; a flip makes up to 1/255
PASSES = ("forward", "backward")


class Backend(NamedTuple):
    """A renderer."""

    name: str
    device: torch.device = CPU  # device of its tensors
    culling: tuple[str, ...] = ()  # names of the culling that can be switched off


Inputs = tuple[Gaussians, Cameras, Tensor]  # see `prepare`


class Outputs(NamedTuple):
    """The results of both passes."""

    image: Tensor  # [V, 3, H, W]
    gradients: tuple[Tensor, ...]  # gradients of FIELDS, in that order
    seconds: dict[str, float]  # durations of "forward" and "backward"
    stats: dict[str, int]


def find_backends() -> list[Backend]:
    """List the reference, then the fast backends that can run here."""
    backends = [Backend("reference"), Backend("cpu", culling=CULLING)]
    if torch.cuda.is_available():
        without_rows = tuple(name for name in CULLING if name != "rows")
        backends.append(Backend("cuda", torch.device("cuda"), without_rows))
    return backends


def prepare(scene: Scene, device: torch.device = CPU, ignored: Tensor | None = None) -> Inputs:
    """Move a scene to a device.

    Returns:
        Gaussians that require gradients, cameras, and the gradient of the image [V, 3, H, W],
        from a normal distribution: the same at every call, but for 0 at the pixels `ignored`,
        [V, H, W].
    """
    gaussians, cameras = (part.to(device) for part in scene)
    size = (cameras.num_views, 3, cameras.height, cameras.width)
    weights = torch.randn(size, generator=torch.Generator().manual_seed(1))
    if ignored is not None:
        weights = weights * ~ignored[:, None]
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    return leaves, cameras, weights.to(gaussians.means)


def run(backend: Backend, inputs: Inputs, *off: str) -> Outputs:
    """Render without background and the culling that is `off`, and compute the gradients."""
    gaussians, cameras, weights = inputs
    leaves = [getattr(gaussians, name) for name in FIELDS]
    start = device_time(backend.device)
    with without_culling(*off):
        out = render(gaussians, cameras, backend=backend.name, depth=False)
    middle = device_time(backend.device)
    gradients = torch.autograd.grad(out.image, leaves, weights)
    seconds = {"forward": middle - start, "backward": device_time(backend.device) - middle}
    return Outputs(out.image.detach(), gradients, seconds, out.stats)


def run_exact(scene: Scene, ignored: Tensor | None = None) -> Outputs:
    """Render the scene by the reference in float64."""
    exact = tuple(part.to(torch.float64) for part in scene)
    return run(Backend("reference"), prepare(exact, ignored=ignored))


def flips(outputs: Outputs, exact: Outputs) -> Tensor:
    """Find the pixels [V, H, W] at which rounding decided otherwise at a cut-off."""
    return ((outputs.image.cpu().double() - exact.image).abs() > FLIP).any(1)


def errors(outputs: Outputs, exact: Outputs, ignored: Tensor) -> Result:
    """Compare images and gradients, in L2, outside the pixels `ignored`, [V, H, W].

    Returns also the fraction of these pixels, "flipped".
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
    """
    names = list(SCENES) if options.scenes == "all" else options.scenes
    check_names("scenes", names, SCENES)
    names = track(names, "scenes", console=console)
    return {"rows": [row for name in names for row in _measure_scene(name, options.repeats)]}


def _measure_scene(name: str, repeats: int) -> list[Result]:
    backends = find_backends()
    scene = SCENES[name]()
    small = SMALLER[name]() if name in SMALLER else scene
    # Where the rounding of any backend decides about a cut-off, more than rounding differs.
    exact = run_exact(small)
    fast = [run(b, prepare(small, b.device)) for b in backends]
    ignored = torch.stack([flips(outputs, exact) for outputs in fast]).any(0)
    exact = run_exact(small, ignored)
    measurements = []
    for backend in backends:
        inputs = prepare(scene, backend.device)
        small_inputs = prepare(small, backend.device, ignored)
        for off in (None, *backend.culling):
            kinds = [] if off is None else [off]
            run_once = partial(run, backend, inputs, *kinds)
            error = errors(run(backend, small_inputs, *kinds), exact, ignored)
            row = {"scene": name, "backend": backend.name, "without": off, **_sizes(scene)}
            row["error"] = {"measured_on": _sizes(small), **error}
            row["stats"] = run_once().stats
            measurements.append(Measurement(lambda run_once=run_once: run_once().seconds, row))
    timing.time_in_rounds(measurements, repeats)
    return [m.row | {name: m.summary(name) for name in PASSES} for m in measurements]


def _sizes(scene: Scene) -> dict[str, int]:
    gaussians, cameras = scene
    sizes = {"gaussians": gaussians.num_gaussians, "views": cameras.num_views}
    return sizes | {"height": cameras.height, "width": cameras.width}


def tables(results: Result) -> list[Table]:
    """Show all rows."""
    notes = (
        f"{machine_note(results)}; *: errors of a smaller scene of the same make;\n"
        "errors outside the pixels where some backend's rounding decides otherwise at a cut-off"
    )
    columns = {
        "scene": text("{scene}"),
        "backend": lambda r: f"  no {r['without']} culling" if r["without"] else r["backend"],
        "forward\nms": median_iqr_column("forward"),
        "backward\nms": median_iqr_column("backward"),
        "image\np99": error("error.image_p99"),
        "image\nmax": error("error.image_max"),
        "flips\n1e-6": number("error.flipped", "{:.0f}", unit=1e-6),
        "gradients\nworst": error("error.gradients"),
    }
    title = "Every backend, and without one kind of culling"
    return [make_table(title, columns, results["rows"], notes, names=2)]


def plot(results: Result) -> Figure:
    """Plot the forward and the backward pass of every backend with all its culling."""
    labels = {
        "forward": ("image against float64, 99th percentile", "error.image_p99"),
        "backward": ("worst gradient against float64, relative L2", "error.gradients"),
    }
    rows = [row for row in results["rows"] if row["without"] is None]
    return time_against_error(rows, labels)
