"""Bad input: an error that names the field, the index and the fix."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.rendering import render
from asysplat.scene import Gaussians


@pytest.mark.parametrize(
    "name, shape",
    [("means", (12, 2)), ("quats", (12, 3)), ("scales", (11, 3)), ("sh", (12, 4, 1))],
)
def test_shapes_of_gaussians(make_scene, name, shape):
    gaussians, _ = make_scene()
    # The type checker of the tests would complain first.
    object.__setattr__(gaussians, name, torch.ones(shape))
    with pytest.raises(InputError, match=rf"Gaussians.{name} has shape .*: expected \(12, "):
        gaussians.__post_init__()


@pytest.mark.parametrize("height, width", [(0, 4), (4, 0), (-1, 4)])
def test_empty_images(make_scene, height, width):
    _, cameras = make_scene()
    with pytest.raises(InputError, match="an image needs at least one pixel"):
        replace(cameras, height=height, width=width)


def test_incompatible_batches_and_backgrounds(backend, make_scene):
    gaussians, cameras = make_scene(views=2)
    with pytest.raises(InputError, match=r"\(2,\) and its cameras \(\): give both the same"):
        render(Gaussians.stack([gaussians] * 2), cameras, backend=backend.name)
    for shape in ((1,), (3, 3), (3, 1, 1)):
        with pytest.raises(InputError, match=r"background has shape .*: expected \(3,\) or \(2, 3"):
            render(gaussians, cameras, torch.ones(shape), backend=backend.name)


@pytest.mark.parametrize("name", ["means", "opacities", "intrinsics", "background"])
def test_integer_tensors(backend, make_scene, name):
    gaussians, cameras = make_scene()
    background = torch.zeros(3, dtype=torch.int64 if name == "background" else torch.float64)
    if hasattr(gaussians, name):
        object.__setattr__(gaussians, name, getattr(gaussians, name).long())
    elif name != "background":
        object.__setattr__(cameras, name, getattr(cameras, name).long())
    with pytest.raises(InputError, match=rf"{name} is torch.int64: give floating-point numbers"):
        render(gaussians, cameras, background, backend=backend.name)


def test_different_devices(backend, make_scene):
    gaussians, cameras = make_scene()
    with pytest.raises(InputError, match=r"cameras.intrinsics is on meta and gaussians.means on"):
        render(gaussians, cameras.to("meta"), backend=backend.name)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["intrinsics", "cam_to_world"])
def test_non_finite_cameras(backend, make_scene, name, value):
    gaussians, cameras = make_scene(views=3)
    getattr(cameras, name)[1, 0, 0] = value
    with pytest.raises(InputError, match=rf"{name}\[1\] holds NaN or infinity"):
        render(gaussians, cameras, backend=backend.name, validate=True)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"views_at_once": 0}, "views_at_once is 0: give at least 1, or None"),
        ({"views_at_once": -1}, "views_at_once is -1: give at least 1, or None"),
        ({"depth": "mean"}, "depth is 'mean': choose True, False or one of accumulated, expected"),
        ({"sh_degree": 4}, "sh_degree is 4: choose 0, 1, 2, 3 or None"),
        ({"backend": "gpu"}, "backend='gpu': expected one of auto, reference, cpu"),
    ],
    ids=str,
)
def test_unknown_options(make_scene, options, message):
    gaussians, cameras = make_scene()
    with pytest.raises(InputError, match=message):
        render(gaussians, cameras, **options)
