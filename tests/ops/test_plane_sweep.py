"""The plane sweep: its backends against the reference in float64, known depths, and views
without depth information."""

import inspect
from importlib import import_module

import pytest
import torch
from compiler import DEVICE, INTERPRETED
from surfaces import (
    cameras_at,
    depth_of_plane,
    four_cameras,
    maps_of,
    slanted_plane,
    texture,
    turned,
)

from asysplat.errors import InputError
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.models.prior.projections import (
    PairwiseProjections,
    choose_neighbors,
    inverse_depth_range,
)
from asysplat.ops.plane_sweep import reference
from asysplat.scene import Cameras

FAST = [
    pytest.param("cpu", marks=pytest.mark.skipif(INTERPRETED, reason="for cuda alone")),
    pytest.param("cuda", marks=[] if INTERPRETED else pytest.mark.gpu),
]
DEVICES = {"cpu": "cpu", "cuda": DEVICE}
# height, width, scenes, views, neighbors, planes
SIZES = [
    (6, 8, 1, 3, 2, 16),
    (9, 6, 1, 2, 4, 5),
    (3, 4, 2, 3, 2, 20),  # smaller than a patch
    (1, 1, 1, 2, 1, 4),
]
LARGER = [(32, 48, 1, 5, 4, 64), (30, 21, 2, 4, 3, 33), (16, 16, 1, 1, 4, 64)]
if not INTERPRETED:
    SIZES += LARGER


per_sweep = pytest.mark.parametrize("backend", ["reference", "cpu"])


def cost_arguments(height, width, scenes, views, neighbors, planes):
    """The inputs of `cost_volume`, in float32: noise seen by slightly rotated cameras."""
    centers = [(0.2 * v, 0.1 * (v % 2), 0.05 * v) for v in range(views)]
    cameras = cameras_at(centers, height=height, width=width, scenes=scenes)
    angles = 0.1 * torch.randn(scenes, views, 3, 3, dtype=torch.float64)
    cameras.cam_to_world[..., :3, :3] = torch.linalg.matrix_exp(angles - angles.mT)
    cameras = cameras.to(torch.float32)
    between = PairwiseProjections.from_cameras(cameras)
    chosen = choose_neighbors(cameras, between, neighbors)
    ranges = inverse_depth_range(cameras, between, chosen)
    images = torch.rand(scenes, views, height, width)
    return images, chosen, between.matrices(chosen, height, width), ranges, planes


def converted(arguments, target):
    return [a.to(target) if torch.is_tensor(a) and a.is_floating_point() else a for a in arguments]


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("backend", FAST)
def test_cost_volume_equals_the_reference(backend, size):
    form = import_module(f"asysplat.ops.plane_sweep.{backend}")
    arguments = cost_arguments(*size)
    exact = reference.cost_volume(*converted(arguments, torch.float64))
    device = DEVICES[backend]
    got = form.cost_volume(*(a.to(device) if torch.is_tensor(a) else a for a in arguments))
    assert got.dtype == torch.float32 and got.shape == exact.shape
    # Inside the image may depend on the last bit at its border: at one pixel in a thousand.
    error = (got.cpu() - exact).abs()
    assert (error > 2e-5).double().mean() <= 1e-3, error.max()


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("backend", FAST)
def test_sgm_equals_the_reference(backend, size):
    height, width, scenes, views, _, planes = size
    form = import_module(f"asysplat.ops.plane_sweep.{backend}")
    costs = 2 * torch.rand(scenes, views, height, width, planes)
    weights = torch.rand(scenes, views, height, width)
    edges = 0.2 * torch.rand(scenes, views, 2, height, width)
    exact = reference.sgm(costs.double(), weights.double(), edges.double())
    got = form.sgm(*(tensor.to(DEVICES[backend]) for tensor in (costs, weights, edges)))
    for there, here in zip(exact, got, strict=True):
        assert here.dtype == torch.float32 and here.shape == there.shape
        # Two planes may cost the same to the last bit: at one pixel in a hundred.
        assert ((here.cpu() - there).abs() > 1e-3).double().mean() <= 1e-2


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("backend", FAST)
def test_consistency_equals_the_reference(backend, size):
    """Depths of which some agree, in slightly rotated views."""
    form = import_module(f"asysplat.ops.plane_sweep.{backend}")
    _, chosen, projections, ranges, _ = cost_arguments(*size)
    height, width, scenes, views = size[:4]
    inverse = ranges.mean(-1)[..., None, None] * (1 + torch.rand(scenes, views, height, width)) / 2
    trust = torch.rand(scenes, views, height, width)
    arguments = inverse, inverse.mean((-1, -2)) / 4, trust, chosen, projections
    exact = reference.consistency(*converted(arguments, torch.float64), tolerance=0.05)
    got = form.consistency(*(tensor.to(DEVICES[backend]) for tensor in arguments), tolerance=0.05)
    for name, there, here in zip(exact._fields, exact, got, strict=True):
        assert here.dtype == torch.float32 and here.shape == there.shape
        # Inside and agreeing may depend on the last bit: at one pixel in a thousand.
        assert ((here.cpu() - there).abs() > 1e-5).double().mean() <= 1e-3, name
    if len(chosen[0]) > 1 and height > 4:
        assert all(counts.any() for counts in exact)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("backend", FAST)
def test_spread_equals_the_reference(backend, size):
    height, width, scenes, views = size[:4]
    form = import_module(f"asysplat.ops.plane_sweep.{backend}")
    values = torch.rand(scenes, views, height, width, 9)
    keep = torch.rand(scenes, views, 2, height, width)
    exact = reference.spread(values.double(), keep.double())
    given = values.to(DEVICES[backend])
    got = form.spread(given, keep.to(DEVICES[backend]))
    assert got.dtype == torch.float32 and torch.equal(given.cpu(), values)
    torch.testing.assert_close(got.cpu().double(), exact, rtol=1e-5, atol=0)


@pytest.mark.skipif(INTERPRETED, reason="slow")
def test_plane_sweep_equals_the_reference():
    cameras = four_cameras()
    images, _ = slanted_plane(cameras)
    exact = plane_sweep(images, cameras, backend="reference")
    got = plane_sweep(images.float(), cameras.to(torch.float32), backend="cpu")
    for name in ("inverse_depth", "confidence"):
        error = (getattr(got, name) - getattr(exact, name)).abs()
        assert (error > 1e-3).double().mean() <= 1e-2, name


def relative_error(found, depth):
    return (found.inverse_depth * depth - 1).abs()


@pytest.mark.parametrize("exposure", [False, True])
def test_depth_of_a_textured_plane(exposure):
    """In photographs of one exposure, or of several."""
    cameras = four_cameras()
    images, depth = slanted_plane(cameras)
    if exposure:
        gain = torch.tensor([1, 0.6, 0.8, 1], dtype=torch.float64).view(1, 4, 1, 1, 1)
        offset = torch.tensor([0, 0.1, 0.05, 0], dtype=torch.float64).view(1, 4, 1, 1, 1)
        images = gain * images + offset
    found = plane_sweep(images, cameras)
    error = relative_error(found, depth)
    median, most = (0.02, 0.06) if exposure else (0.015, 0.05)
    assert error.median() < median and error.quantile(0.9) < most
    assert found.confidence.median() > 0.9
    assert found.confidence.mean() > (0.9 if exposure else 0.85)


def test_occluded_points_have_less_confidence():
    """A square in front of a wall: one of two cameras sees some of the wall alone."""
    cameras = cameras_at([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)])
    wall, wall_points = depth_of_plane(cameras, 3.0)
    square, square_points = depth_of_plane(cameras, 1.5)

    def within(points):
        return (points[..., :2] - torch.tensor([0.1, 0.0])).abs().amax(-1) < 0.35

    covered = within(square_points)
    images = torch.where(
        covered[:, :, None], texture(square_points, scale=0.5, seed=1), texture(wall_points)
    )
    # Points of the wall that the square occludes in the other view.
    other = cameras.centers.flip(1)[..., None, None, :]
    hidden = within(other + (wall_points - other) / 2) & ~covered
    found = plane_sweep(images, cameras)
    assert relative_error(found, torch.where(covered, square, wall))[~hidden].median() < 0.05
    assert found.confidence[hidden].mean() < 0.75 * found.confidence[~hidden & ~covered].mean()


def test_results_scale_with_the_unit_of_length():
    cameras = four_cameras()
    images, _ = slanted_plane(cameras)
    at_one = plane_sweep(images, cameras)
    for scale in (1e-3, 1e4):
        scaled = cameras.map(torch.clone)
        scaled.cam_to_world[..., :3, 3] *= scale
        found = plane_sweep(images, scaled)
        at_scale = (found.inverse_depth * scale, found.confidence)
        expected = (at_one.inverse_depth, at_one.confidence)
        torch.testing.assert_close(at_scale, expected, rtol=1e-4, atol=1e-6)


def test_scenes_of_a_batch_are_independent():
    cameras = four_cameras()
    scenes = [slanted_plane(cameras, seed=seed)[0].float() for seed in range(2)]
    together = plane_sweep(torch.cat(scenes), cameras.map(lambda t: t.float().repeat(2, 1, 1, 1)))
    for scene, images in enumerate(scenes):
        alone = plane_sweep(images, cameras.to(torch.float32))
        for name, value in maps_of(alone).items():
            torch.testing.assert_close(maps_of(together)[name][scene], value[0], msg=name)


def estimate(cameras, backend, images=None):
    """Run the plane sweep in float32, and check that the result is in range."""
    if images is None:
        images = torch.rand(*cameras.intrinsics.shape[:2], 3, cameras.height, cameras.width)
    found = plane_sweep(images.float(), cameras.to(torch.float32), backend=backend)
    assert found.inverse_depth.isfinite().all() and (found.inverse_depth >= 0).all()
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()
    return found


SQUARE = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.3, 0.3, 0.0)]
SURE = {
    "one behind the other": (cameras_at([(0.0, 0.0, 0.4 * v) for v in range(4)]), 3.0, 0.9),
    "wide": (cameras_at(SQUARE, focal=0.3), 0.9, 0.5),
    "telescopic": (cameras_at(SQUARE, focal=30), 90.0, 0.5),
}


@per_sweep
@pytest.mark.parametrize("name", SURE)
def test_confident_depths_are_right_for_any_lens_and_line_of_cameras(backend, name):
    cameras, distance, sure = SURE[name]
    images, depth = slanted_plane(cameras, distance)
    found = estimate(cameras, backend, images)
    assert relative_error(found, depth)[found.confidence > sure].median() < 0.1


NO_DEPTH = {f"{n} at one place": [cameras_at([(0.3, -2.0, 1.0)] * n)] for n in (1, 2, 5)}
NO_DEPTH["no overlap"] = [cameras_at([(0, 0, 1)]), turned(cameras_at([(0, 0, -1)]), 180)]
ANY_CAMERAS = {
    "facing each other": [cameras_at([(0, 0, 0)]), turned(cameras_at([(0, 0, 4)]), 180)],
    "at right angles": [turned(cameras_at([(0.1 * v, 0, 0)]), 90 * v) for v in (0, 1, 2, 3, 0)],
    "of several focal lengths": [
        cameras_at([(0.1 * i, 0, 0)], focal=focal) for i, focal in enumerate((0.3, 1, 30))
    ],
}


@per_sweep
@pytest.mark.parametrize("name", [*NO_DEPTH, *ANY_CAMERAS])
def test_results_are_in_range_for_any_cameras_and_0_without_parallax_or_overlap(backend, name):
    parts = (NO_DEPTH | ANY_CAMERAS)[name]
    cameras = Cameras(
        torch.cat([part.intrinsics for part in parts], 1),
        torch.cat([part.cam_to_world for part in parts], 1),
        parts[0].height,
        parts[0].width,
    )
    found = estimate(cameras, backend)
    if name in NO_DEPTH:
        assert not found.confidence.any() and not found.inverse_depth.any()


@per_sweep
@pytest.mark.parametrize("value, noise, most", [(0.0, 0, 0.05), (1.0, 0, 0.05), (0.99, 1e-6, 1e-5)])
def test_blank_images_have_no_confidence(backend, value, noise, most):
    """A variance of 1e-12, beside the squares of the pixels, would be noise of 1e-7."""
    cameras = four_cameras()
    images = value + noise * torch.rand(1, 4, 3, cameras.height, cameras.width)
    assert estimate(cameras, backend, images).confidence.max() < most


@per_sweep
def test_noise_has_less_confidence_than_texture(backend):
    cameras = four_cameras()
    noise = estimate(cameras, backend).confidence.mean()
    assert noise < 0.75 * estimate(cameras, backend, slanted_plane(cameras)[0]).confidence.mean()


def test_any_number_of_threads_gives_the_same_bits(threads):
    cameras = four_cameras()
    images = torch.rand(1, 4, 3, cameras.height, cameras.width)
    threads(1)
    one = maps_of(estimate(cameras, "cpu", images))
    for count in (2, 3):
        threads(count)
        for name, value in maps_of(estimate(cameras, "cpu", images)).items():
            assert torch.equal(value, one[name]), (count, name)


def test_shapes_on_the_meta_device():
    images = torch.empty(1, 4, 3, 24, 32, device="meta")
    found = plane_sweep(images, four_cameras().to("meta", torch.float32))
    assert found.inverse_depth.shape == found.confidence.shape == (1, 4, 24, 32)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"images": torch.zeros(1, 3, 3, 24, 32)}, r"have shape .* expected \(1, 4, 3, 24, 32\)"),
        ({"planes": 3}, "planes=3 .* at least 4 planes"),
        ({"neighbors": 0}, "neighbors=0: give at least 4 planes and one neighbor"),
        ({"backend": "fast"}, "backend='fast': expected one of auto, reference, cpu, cuda"),
        ({"backend": "cpu"}, "backend 'cpu' computes in float32 and x is float64: choose 'auto'"),
    ],
    ids=str,
)
def test_images_and_cameras_that_do_not_fit_are_named(change, message):
    arguments = {"images": torch.zeros(1, 4, 3, 24, 32).double(), "cameras": four_cameras()}
    with pytest.raises(InputError, match=message):
        # Without the tests' type checker, which would raise first.
        inspect.unwrap(plane_sweep)(**arguments | change)
