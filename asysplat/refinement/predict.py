"""Gaussians of photographs in so many seconds."""

import time

from asysplat.ranges import Positive, check_options
from asysplat.refinement.init import gaussians_of_pixels, initial_gaussians, sweep
from asysplat.refinement.refine import refine
from asysplat.refinement.settings import BRIEF, DEFAULT, FEW
from asysplat.scene import Gaussians, Views

BRIEF_UNTIL = 5.0  # seconds, of two cores and 128x128 pixels, from which densification pays
STEPS_PAY_FROM = 2.2  # times the seconds of the plane sweep, of two cores


def predict(views: Views, seconds: float | int = 1.0, *, seed: int = 0) -> Gaussians:
    """Compute the Gaussians of a scene: a plane sweep's, refined for the time that is left.

    Where that is hardly as much as the sweep took, they are one for each pixel instead. The
    first call in a process compiles its kernels beside these seconds.

    Args:
        views: the photographs, [V].
        seconds: > 0; the sweep takes its time in any case.
        seed: see `Refinement`.

    Raises:
        InputError: seconds out of range; see `Refinement`.

    Example:
        >>> from asysplat import open_photographs, predict
        >>> gaussians = predict(open_photographs("my_scene", height=64, views=4).inputs)
    """
    began = time.perf_counter()
    check_options({"seconds": seconds}, {"seconds": Positive})
    at_length = FEW if views.num_views <= DEFAULT.few_views else DEFAULT
    settings = BRIEF if seconds < BRIEF_UNTIL else at_length
    views = views.validate("predict's views")
    estimate = sweep(views)
    if seconds < STEPS_PAY_FROM * (time.perf_counter() - began):
        return gaussians_of_pixels(views, estimate)
    limit = settings.initial_limit
    start = initial_gaussians("plane_sweep", views, limit, estimate=estimate)
    left = max(1e-3, seconds - (time.perf_counter() - began))
    return refine(start, views, settings, seconds=left, seed=seed, estimate=estimate)
