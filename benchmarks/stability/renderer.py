"""The renderer on hostile Gaussians and cameras."""

from collections.abc import Iterator, Sequence
from functools import partial

import torch

from asysplat.rendering import render
from asysplat.rendering.interface import RenderSettings
from asysplat.scene import Cameras, Gaussians
from benchmarks.stability.boundary_band import boundary_band
from benchmarks.stability.comparison import StabilityCase, Tensors, compare_to_reference
from benchmarks.stability.hostile import (
    FIELDS,
    HOSTILE_GAUSSIANS,
    HostileViews,
    hostile_gaussians,
    hostile_views,
    scattered_gaussians,
)
from benchmarks.timing import Result


def renderer_cases(counts: Sequence[int]) -> Iterator[StabilityCase]:
    """Yield the cases of hostile Gaussians, then of cameras; `counts` are numbers of views."""
    views = HostileViews()
    for name in HOSTILE_GAUSSIANS:
        yield StabilityCase(f"Gaussians {name}", "fp32", partial(measure, views, name))
    for name, hostile in hostile_views(counts).items():
        if "photographs" not in name:  # the renderer uses only the cameras
            yield StabilityCase(name, "fp32", partial(measure, hostile))
    for precision, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        run = partial(measure, views, dtype=dtype)
        yield StabilityCase("inputs in half precision", precision, run)


def measure(
    hostile: HostileViews,
    name: str | None = None,
    dtype: torch.dtype = torch.float32,
    backend: str = "cpu",
) -> Result:
    """Compare images, alphas, depths and all gradients of a backend with the reference.

    Pixels of the `boundary_band` are excluded: rounding may flip a decision there.

    Args:
        hostile: views whose cameras are rendered.
        name: key of HOSTILE_GAUSSIANS; None for scattered Gaussians.
        dtype: dtype of the Gaussians.
        backend: backend under test.
    """
    cameras = hostile.cameras()
    gaussians = scattered_gaussians(cameras)
    if name is not None:
        gaussians = hostile_gaussians(name, gaussians, cameras)
    gaussians = gaussians.to(dtype)
    inputs = {name: getattr(gaussians, name) for name in FIELDS}
    inputs |= {name: getattr(cameras, name) for name in ("cam_to_world", "intrinsics")}
    inside = ~boundary_band(gaussians, cameras, RenderSettings())
    size = (cameras.height, cameras.width)

    def draw(backend: str, tensors: Tensors) -> Tensors:
        views = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *size)
        out = render(Gaussians(*(tensors[name] for name in FIELDS)), views, backend=backend)
        image, alpha, depth = out.image * inside[:, None], out.alpha * inside, out.depth * inside
        return {"image": image, "alpha": alpha, "depth": depth}

    fraction = inside.double().mean().item()
    note = f"at {fraction:.1%} of the pixels: at the others rounding decides about a cut-off"
    fast, exact = partial(draw, backend), partial(draw, "reference")
    row = compare_to_reference(fast, exact, inputs, tuple(inputs))
    return row | {"compared": f"{row['compared']}; {note}"}
