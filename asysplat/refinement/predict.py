"""Gaussians of photographs in so many seconds, or of a network in windows of photographs."""

import time

import torch

from asysplat.models.network import Network
from asysplat.ranges import Count, Positive, check_options
from asysplat.refinement.init import (
    DEPTH_VIEWS,
    gaussians_of_pixels,
    initial_gaussians,
    sweep,
    without_invisible,
)
from asysplat.refinement.refine import is_covered, refine
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


@torch.no_grad()
def predict_in_windows(network: Network, views: Views, window: int = DEPTH_VIEWS) -> Gaussians:
    """Predict Gaussians from at most `window` views at a time, where a network cannot take all.

    Memory and time grow with the number of views, and not with its square, as those of attention
    do. The windows interleave: each shows the whole scene. Of those after the first, Gaussians are
    added that some view shows in a pixel which the ones before leave open.

    Args:
        network: maps views to Gaussians, on the views' device.
        views: [V].
        window: most views at a time, at least 1.

    Raises:
        InputError: window out of range; see `Network.forward`.

    Example:
        >>> from asysplat import load, open_photographs
        >>> from asysplat.refinement import predict_in_windows
        >>> views = open_photographs("my_scene", height=64, views=8).inputs
        >>> gaussians = predict_in_windows(load("shipped"), views, window=4)
    """
    check_options({"window": window}, {"window": Count})
    windows = -(-views.num_views // window)
    found = None
    for first in range(windows):
        part = views.select(range(first, views.num_views, windows))
        new = without_invisible(network(part))
        if found is not None:
            new = found.join(new.keep(~is_covered(new.means, found, part.cameras)))
        found = new
    assert found is not None  # there are views
    return found
