"""The scenes that the renderers are timed on, each with one that float64 can afford."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from asysplat.benchmark.options import check_names
from asysplat.benchmark.scenes import Scene, on_an_arc, pixel_aligned_scene, random_scene


class Case(NamedTuple):
    """A scene to time."""

    make: Callable[[], Scene]
    twin: Callable[[], Scene] | None = None  # a smaller one, if errors are measured on that


def _from_views(views: int) -> Scene:
    gaussians, camera = pixel_aligned_scene(256, 256, 256)
    return gaussians, on_an_arc(camera, views)


CASES = {
    "A": Case(partial(random_scene, 50_000, 256, 256)),
    "B": Case(partial(random_scene, 50_000, 540, 960)),
    "C": Case(partial(pixel_aligned_scene, 256, 256, 256)),
    "524k": Case(partial(pixel_aligned_scene, 512, 256, 256)),
    "4M": Case(
        partial(pixel_aligned_scene, 1414, 540, 960),
        twin=partial(pixel_aligned_scene, 354, 135, 240),
    ),
    "131kx16": Case(partial(_from_views, 16), twin=partial(_from_views, 2)),
}


def find_cases(names: str | Sequence[str]) -> dict[str, Case]:
    """Find the scenes called `names`: one, several, or "all".

    Raises:
        InputError: a name that no scene has, or none.
    """
    names = [names] if isinstance(names, str) else list(names)
    if names == ["all"]:
        return CASES
    check_names("scenes", names, [*CASES, "all"])
    return {name: CASES[name] for name in names}


def describe(scene: Scene) -> dict[str, int]:
    """Count its Gaussians, views and pixels."""
    gaussians, cameras = scene
    return {
        "gaussians": gaussians.num_gaussians,
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
    }
