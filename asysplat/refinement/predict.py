"""Gaussians of photographs in so many seconds."""

import time

from asysplat.ranges import Positive, check_options
from asysplat.refinement.init import initial_gaussians
from asysplat.refinement.refine import refine
from asysplat.refinement.settings import BRIEF, DEFAULT, FEW
from asysplat.scene import Gaussians, Views

BRIEF_UNTIL = 5.0  # seconds, of two cores and 128x128 pixels, from which densification pays


def predict(views: Views, seconds: float | int = 1.0, *, seed: int = 0) -> Gaussians:
    """Compute the Gaussians of a scene: the plane sweep's, refined for the time that is left.

    The first call in a process compiles its kernels beside these seconds.

    Args:
        views: the photographs, [V].
        seconds: > 0; without time for a step, the Gaussians are those of the plane sweep.
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
    gaussians = initial_gaussians("plane_sweep", views, settings.initial_limit)
    left = seconds - (time.perf_counter() - began)
    return refine(gaussians, views, settings, seconds=left, seed=seed) if left > 0 else gaussians
