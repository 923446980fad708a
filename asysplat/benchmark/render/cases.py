"""The scenes that the renderers are timed on, each with one that float64 can afford."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from asysplat.benchmark.scenes import on_an_arc, pixel_aligned_scene, random_scene
from asysplat.errors import InputError
from asysplat.scene import Cameras, Gaussians

Scene = tuple[Gaussians, Cameras]


@dataclass(frozen=True)
class Case:
    """
    Args:
        make: the scene that is timed.
        twin: a smaller one of the same make that errors are measured on; None where they are
            measured on the scene itself.
    """

    make: Callable[[], Scene]
    twin: Callable[[], Scene] | None = None


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
    """The scenes called `names`: one, several, or "all".

    Raises:
        InputError: a name that no scene has, or none.
    """
    words = [names] if isinstance(names, str) else list(names)
    if words == ["all"]:
        return CASES
    for word in words or [None]:
        if word not in CASES:
            raise InputError(f"scenes={word} is unknown: choose some of {', '.join(CASES)} or all.")
    return {word: CASES[word] for word in words}


def describe(scene: Scene) -> dict[str, int]:
    """How large it is."""
    gaussians, cameras = scene
    return {
        "gaussians": gaussians.num_gaussians,
        "views": cameras.num_views,
        "height": cameras.height,
        "width": cameras.width,
    }
