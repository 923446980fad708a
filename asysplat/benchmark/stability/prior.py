"""The plane sweep, and the prior that is made of it."""

from collections.abc import Iterator, Sequence
from functools import partial

from asysplat.benchmark.stability.judge import Case, Comparison, Function, Tensors, judge
from asysplat.benchmark.stability.views import Hostile, hostile_views
from asysplat.benchmark.timing import Result
from asysplat.models.prior import PlaneSweepPrior
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.scene import Cameras, Views

NEARLY_0 = 1e-30  # where nothing is found the greatest is 0


def sweeps() -> Iterator[Case]:
    """Yield the cases of the plane sweep, an operator."""
    for name, hostile in hostile_views(Hostile()).items():
        measure = partial(_measure, _sweep, hostile)
        yield Case("operators", f"plane_sweep, {name}", "fp32", measure)


def cases(counts: Sequence[int]) -> Iterator[Case]:
    """Yield the cases of the prior, also for these numbers of views."""
    for name, hostile in hostile_views(Hostile(), counts).items():
        yield Case("prior", name, "fp32", partial(_measure, _prior, hostile))


def _measure(function: Function, hostile: Hostile) -> Result:
    views = hostile.views()
    inputs = {
        "images": views.images[None],
        "intrinsics": views.cameras.intrinsics[None],
        "cam_to_world": views.cameras.cam_to_world[None],
    }
    return judge(Comparison(function, function, inputs, size=1.0))


def _cameras(tensors: Tensors) -> Cameras:
    return Cameras(tensors["intrinsics"], tensors["cam_to_world"], *tensors["images"].shape[-2:])


def _sweep(tensors: Tensors) -> Tensors:
    """Return what is found, as far as it is trusted, over the greatest."""
    found = plane_sweep(tensors["images"], _cameras(tensors))
    inverse = found.inverse_depth / found.inverse_depth.max().clamp_min(NEARLY_0)
    return {
        "confidence": found.confidence,
        "confidence x inverse depth": found.confidence * inverse,
    }


def _prior(tensors: Tensors) -> Tensors:
    images = tensors["images"]
    found = PlaneSweepPrior()(Views(_cameras(tensors), images), tuple(images.shape[-2:]))
    return {
        "confidence": found.confidence,
        "confidence x log distance": found.confidence * found.distance.log(),
        "opacity": found.opacity,
    }
