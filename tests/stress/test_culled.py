"""Culled Gaussians do not change the others: cases 1, 2, 6, 9, 14 and 32."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from backends import BACKGROUND, FIELDS, INTERPRETED, assert_as_without, both_ways, facing

from asysplat.errors import InputError
from asysplat.rendering import INRIA, render

NAN, INF = math.nan, math.inf


@pytest.fixture(scope="session")
def make_scene(make_scene):
    """Two tiles an image for Triton's interpreter, whose time is proportional to them."""
    return partial(make_scene, height=7, width=9) if INTERPRETED else make_scene


def spoiled(make_scene, **values):
    """Return a scene whose Gaussian 3 has these values, the scene without it, and the cameras."""
    gaussians, cameras = make_scene(views=2, dtype=torch.float32)
    clean = gaussians.keep(torch.arange(12) != 3)
    for name, value in values.items():
        getattr(gaussians, name)[3] = torch.as_tensor(value)
    return gaussians, clean, cameras


@pytest.mark.parametrize(
    "mean",
    [
        pytest.param((0.0, 0.0, 0.0), id="at the camera"),
        pytest.param((0.3, -0.2, 0.0), id="in its plane"),
        pytest.param((0.3, -0.2, -0.0), id="in its plane, -0"),
        pytest.param((0.1, 0.1, -2.0), id="behind"),
        pytest.param((0.1, 0.1, -1e-30), id="just behind"),
        pytest.param((0.0, 0.0, 1e-40), id="denormal depth"),
        pytest.param((0.0, 0.0, INRIA.near), id="at the near plane"),
    ],
)
def test_case_01_no_depth_is_culled(backend, make_scene, mean):
    gaussians, clean, cameras = spoiled(make_scene, means=mean)
    cameras = facing(cameras)
    convention = replace(INRIA, near=float(torch.tensor(INRIA.near).to(backend.dtype)))
    result = both_ways(backend, gaussians, cameras, convention=convention)
    clean = both_ways(backend, clean, cameras, convention=convention)
    assert result.is_finite()
    assert_as_without(result, clean, 3)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("scale", [1e20, 1e38, INF, (1e38, 1e-38, 1e-45)], ids=str)
def test_case_06_scales_beyond_reason_are_finite_or_culled(backend, make_scene, scale, antialiased):
    gaussians, clean, cameras = spoiled(make_scene, scales=scale)
    result = both_ways(backend, gaussians, cameras, antialiased=antialiased)
    assert result.is_finite()
    if scale == INF:
        clean = both_ways(backend, clean, cameras, antialiased=antialiased)
        assert_as_without(result, clean, 3)


@pytest.mark.parametrize("quat", [(0.0, 0, 0, 0), (-0.0, 0, -0.0, 0)], ids=["0", "-0"])
def test_case_09_a_zero_quaternion_is_culled(backend, make_scene, quat):
    gaussians, clean, cameras = spoiled(make_scene, quats=quat)
    result = both_ways(backend, gaussians, cameras)
    assert_as_without(result, both_ways(backend, clean, cameras), 3)


@pytest.mark.parametrize("length", [2.0**-60, 2.0**-30, 2.0**30, 2.0**60], ids="{:.0e}".format)
def test_case_09_any_other_length_is_normalized(backend, make_scene, length):
    gaussians, cameras = make_scene(dtype=torch.float32)
    exact = both_ways(backend, gaussians, cameras)
    gaussians.quats[3] *= length
    result = both_ways(backend, gaussians, cameras)
    assert result.is_finite()
    torch.testing.assert_close(result.image, exact.image, rtol=0, atol=backend.image_error)


@pytest.mark.parametrize("what", ["no Gaussians", "none visible", "no pixel touched"])
@pytest.mark.parametrize("depth", ["expected", "median", "accumulated"])
def test_case_14_nothing_to_see_is_the_background(backend, make_scene, what, depth):
    gaussians, cameras = make_scene(views=2, dtype=torch.float32)
    cameras = facing(cameras)
    if what == "no Gaussians":
        gaussians = gaussians.keep(torch.zeros(12, dtype=torch.bool))
    elif what == "none visible":
        gaussians.means[:, 2] -= 20
    else:  # between the centers of four pixels, and too faint to reach one
        cameras.intrinsics[:, 0, 2] = 8
        cameras.intrinsics[:, 1, 2] = 6
        gaussians.means[:, :2] = 0
        gaussians.scales.fill_(1e-4)
        gaussians.opacities.fill_(1.5 / 255)
    result = both_ways(backend, gaussians, cameras, depth=depth)
    background = BACKGROUND.to(backend.dtype)[:, None, None]
    assert (result.image == background).all()
    assert (result.alpha == 0).all() and (result.depth == 0).all()
    assert result.stats["visible"] == 0 and result.stats["pairs"] == 0
    for name, grad in result.grads.items():
        assert name == "background" or (grad == 0).all()
    assert (result.grads["background"] != 0).all()


POISON = {
    "NaN": NAN,
    "Inf": INF,
    "-Inf": -INF,
    "0": 0.0,
    "denormal": 1e-42,
    "1e38": 1e38,
    "-1e38": -1e38,
    "near": INRIA.near,
    "far": 1e6,
    "1/255": 1 / 255,
}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("poison", POISON)
def test_case_32_poison_in_any_slot(backend, make_scene, poison, name):
    """Poison each number of one Gaussian, each in a scene of a batch."""
    gaussians, clean, cameras = spoiled(make_scene)
    slots = getattr(gaussians, name)[3].numel()
    scenes = repeated(gaussians, slots)
    getattr(scenes, name)[:, 3].view(slots, slots).fill_diagonal_(POISON[poison])
    assert both_ways(backend, scenes, repeated(cameras, slots)).is_finite()

    alone = scenes.map(lambda t: t[:, 3:4])
    culled = (both_ways(backend, alone, repeated(cameras, slots)).alpha == 0).flatten(1).all(1)
    if poison in ("NaN", "Inf", "-Inf"):
        assert culled.all()
        with pytest.raises(InputError, match=rf"{name}\[0, 3\] holds NaN or infinity"):
            render(scenes, repeated(cameras, slots), backend=backend.name, validate=True)
    count = int(culled.sum())
    if count:
        cameras = repeated(cameras, count)
        result = both_ways(backend, scenes.map(lambda t: t[culled]), cameras)
        clean = both_ways(backend, repeated(clean, count), cameras)
        assert_as_without(result, clean, 3)


def repeated(record, count):
    """Return a batch of copies."""
    return record.map(lambda t: t.expand(count, *t.shape).clone())
