"""Bad input: an error that names the field, the index and the fix."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.rendering import render
from asysplat.scene import Gaussians


def test_shapes_that_do_not_fit_are_refused(make_scene):
    shapes = {"means": (12, 2), "quats": (12, 3), "scales": (11, 3), "sh": (12, 4, 1)}
    for name, shape in shapes.items():
        gaussians, _ = make_scene()
        # The type checker of the tests would complain first.
        object.__setattr__(gaussians, name, torch.ones(shape))
        with pytest.raises(InputError, match=rf"Gaussians.{name} has shape .*: expected \(12, "):
            gaussians.__post_init__()
    gaussians, cameras = make_scene(views=2)
    for height, width in ((0, 4), (4, -1)):
        with pytest.raises(InputError, match="an image needs at least one pixel"):
            replace(cameras, height=height, width=width)
    with pytest.raises(InputError, match=r"\(2,\) and its cameras \(\): give both the same"):
        render(Gaussians.stack([gaussians] * 2), cameras)
    for shape in ((1,), (3, 3), (3, 1, 1)):
        with pytest.raises(InputError, match=r"background has shape .*: expected \(3,\) or \(2, 3"):
            render(gaussians, cameras, torch.ones(shape))


@pytest.mark.parametrize("name", ["means", "opacities", "intrinsics", "background"])
def test_integers_and_different_devices_are_refused(make_scene, name):
    gaussians, cameras = make_scene()
    with pytest.raises(InputError, match=r"cameras.intrinsics is on meta and gaussians.means on"):
        render(gaussians, cameras.to("meta"))
    background = torch.zeros(3, dtype=torch.int64 if name == "background" else torch.float64)
    for owner in (gaussians, cameras):
        if hasattr(owner, name):
            object.__setattr__(owner, name, getattr(owner, name).long())
    with pytest.raises(InputError, match=rf"{name} is torch.int64: give floating-point numbers"):
        render(gaussians, cameras, background)


@pytest.mark.parametrize(
    "name, place, value, says",
    [
        *[
            (name, (1, 0, 0), value, r"\[1\] holds NaN or infinity")
            for name in ("intrinsics", "cam_to_world")
            for value in (math.nan, -math.inf)
        ],
        *[
            ("opacities", (1,), value, r"\[1\] lies outside \(0, 1\]")
            for value in (1.0 + 1e-6, 0.0, -0.5)
        ],
    ],
)
def test_numbers_that_cannot_be_are_found_by_validation(make_scene, name, place, value, says):
    scene = make_scene(views=3, dtype=torch.float32)
    getattr(scene[name != "opacities"], name)[place] = value
    with pytest.raises(InputError, match=name + says):
        render(*scene, validate=True)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"views_at_once": 0}, "views_at_once is 0: give at least 1, or None"),
        ({"depth": "mean"}, "depth is 'mean': choose True, False or one of accumulated, expected"),
        ({"sh_degree": 4}, "sh_degree is 4: choose 0, 1, 2, 3 or None"),
        ({"backend": "gpu"}, "backend='gpu': expected one of auto, reference, cpu"),
    ],
    ids=str,
)
def test_unknown_options_are_refused(make_scene, options, message):
    with pytest.raises(InputError, match=message):
        render(*make_scene(), **options)
