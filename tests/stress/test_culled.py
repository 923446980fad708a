"""Gaussians that no camera can show are culled, and do not change the others."""

import math
from dataclasses import replace
from functools import partial
from itertools import product

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


def repeated(record, count):
    return record.map(lambda t: t.expand(count, *t.shape).clone())


def spoiled(make_scene, count, **values):
    """`count` scenes, Gaussian 3 of each with its own of these values; scenes without it."""
    gaussians, cameras = make_scene(views=2, dtype=torch.float32)
    scenes = repeated(gaussians, count)
    for name, column in values.items():
        getattr(scenes, name)[:, 3] = torch.tensor(column)
    clean = gaussians.keep(torch.arange(12) != 3)
    return scenes, repeated(clean, count), repeated(cameras, count)


@pytest.mark.parametrize(
    "name, values",
    {
        "means": [
            (0.0, 0.0, 0.0),  # at the camera
            (0.3, -0.2, 0.0),  # in its plane
            (0.3, -0.2, -0.0),
            (0.1, 0.1, -2.0),  # behind
            (0.1, 0.1, -1e-30),
            (0.0, 0.0, 1e-40),  # denormal
            (0.0, 0.0, INRIA.near),
        ],
        "quats": [(0.0, 0, 0, 0), (-0.0, 0, -0.0, 0)],
        "scales": [(INF, INF, INF)],
    }.items(),
    ids=["no depth", "no rotation", "infinite"],
)
@pytest.mark.parametrize("antialiased", [False, True])
def test_what_no_camera_shows_is_culled(backend, make_scene, name, values, antialiased):
    scenes, clean, cameras = spoiled(make_scene, len(values), **{name: values})
    cameras = facing(cameras)
    near = float(torch.tensor(INRIA.near).to(backend.dtype))
    options = {"limits": replace(INRIA, near=near), "antialiased": antialiased}
    result = both_ways(backend, scenes, cameras, **options)
    assert result.is_finite()
    assert_as_without(result, both_ways(backend, clean, cameras, **options), 3)


@pytest.mark.parametrize(
    "what, depth",
    [
        ("no Gaussians", "expected"),
        ("no Gaussians", "median"),
        ("none visible", "accumulated"),
        ("no pixel touched", "median"),
    ],
)
def test_nothing_to_see_is_the_background(backend, make_scene, what, depth):
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
        assert (grad != 0).all() if name == "background" else (grad == 0).all(), name


NOT_FINITE = (NAN, INF, -INF)
POISON = (*NOT_FINITE, 0.0, 1e-42, 1e38, -1e38, INRIA.near, 1e6, 1 / 255)
if INTERPRETED:
    POISON = (*NOT_FINITE, 1e38)


@pytest.mark.parametrize("name", FIELDS)
def test_poison_in_any_slot_is_culled_or_finite(backend, make_scene, name):
    """Each value in each number of one Gaussian, each in a scene of a batch."""
    slots = getattr(make_scene()[0], name)[3].numel()
    scenes, clean, cameras = spoiled(make_scene, len(POISON) * slots)
    numbers = getattr(scenes, name)[:, 3].view(len(POISON), slots, slots)
    for values, poison in zip(numbers, POISON, strict=True):
        values.fill_diagonal_(poison)
    cases = [f"{poison} in slot {slot}" for poison, slot in product(POISON, range(slots))]
    result = both_ways(backend, scenes, cameras)
    for index, case in enumerate(cases):
        assert all(output[index].isfinite().all() for output in result.outputs.values()), case
    assert result.is_finite()

    alone = scenes.map(lambda t: t[:, 3:4])
    culled = (both_ways(backend, alone, cameras).alpha == 0).flatten(1).all(1)
    assert culled[: len(NOT_FINITE) * slots].all()
    with pytest.raises(InputError, match=rf"{name}\[0, 3\] holds NaN or infinity"):
        render(scenes, cameras, backend=backend.name, validate=True)
    result, clean = (
        both_ways(backend, batch.map(lambda t: t[culled]), cameras.map(lambda t: t[culled]))
        for batch in (scenes, clean)
    )
    assert_as_without(result, clean, 3)
