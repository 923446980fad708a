"""Views without depth information: low confidence and no failure."""

import inspect

import pytest
import torch
from surfaces import cameras_at, four_cameras, maps_of, slanted_plane, turned

from asysplat.errors import InputError
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.scene import Cameras


@pytest.fixture(params=["reference", "cpu"])
def backend(request):
    return request.param


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


@pytest.mark.parametrize("name", SURE)
def test_confident_depths_are_right_for_any_lens_and_line_of_cameras(backend, name):
    cameras, distance, sure = SURE[name]
    images, depth = slanted_plane(cameras, distance)
    found = estimate(cameras, backend, images)
    error = (found.inverse_depth * depth - 1).abs()
    assert error[found.confidence > sure].median() < 0.1


NO_DEPTH = {f"{n} at one place": [cameras_at([(0.3, -2.0, 1.0)] * n)] for n in (1, 2, 5)}
NO_DEPTH["no overlap"] = [cameras_at([(0, 0, 1)]), turned(cameras_at([(0, 0, -1)]), 180)]
ANY_CAMERAS = {
    "facing each other": [cameras_at([(0, 0, 0)]), turned(cameras_at([(0, 0, 4)]), 180)],
    "at right angles": [turned(cameras_at([(0.1 * v, 0, 0)]), 90 * v) for v in (0, 1, 2, 3, 0)],
    "of several focal lengths": [
        cameras_at([(0.1 * i, 0, 0)], focal=focal) for i, focal in enumerate((0.3, 1, 30))
    ],
}


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


@pytest.mark.parametrize("value, noise, most", [(0.0, 0, 0.05), (1.0, 0, 0.05), (0.99, 1e-6, 1e-5)])
def test_blank_images_have_no_confidence(backend, value, noise, most):
    """A variance of 1e-12, beside the squares of the pixels, would be noise of 1e-7."""
    cameras = four_cameras()
    images = value + noise * torch.rand(1, 4, 3, cameras.height, cameras.width)
    assert estimate(cameras, backend, images).confidence.max() < most


def test_noise_has_less_confidence_than_texture(backend):
    cameras = four_cameras()
    noise = estimate(cameras, backend).confidence.mean()
    assert noise < 0.75 * estimate(cameras, backend, slanted_plane(cameras)[0]).confidence.mean()


def test_any_number_of_threads_gives_the_same_bits(threads):
    cameras = four_cameras()
    images = torch.rand(1, 4, 3, cameras.height, cameras.width)
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(maps_of(estimate(cameras, "cpu", images)))
        for name, value in results[-1].items():
            assert torch.equal(value, results[0][name]), (count, name)


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
