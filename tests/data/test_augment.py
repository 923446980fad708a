"""Augmentation: crops with their cameras, orders, exposure, noise of inputs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from asysplat.data.augment import Augmentation, center_crop
from asysplat.scene import Cameras, Views

HEIGHT, WIDTH = 45, 80


def make_views(count=3) -> Views:
    """Images whose red and green are the pixel's own position, depths and masks of noise."""
    intrinsics = torch.tensor([[70.0, 0, 43], [0, 66, 20], [0, 0, 1]], dtype=torch.float64)
    intrinsics = intrinsics.repeat(count, 1, 1)
    intrinsics[:, 0, 2] += torch.arange(count)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    image = torch.stack((x / WIDTH, y / HEIGHT, 0 * x)).double()
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    return Views(
        cameras=Cameras(intrinsics, poses, HEIGHT, WIDTH),
        images=image.repeat(count, 1, 1, 1),
        depths=torch.rand(count, HEIGHT, WIDTH, dtype=torch.float64) + 1,
        masks=torch.rand(count, HEIGHT, WIDTH) > 0.3,
        disparities=torch.rand(count, HEIGHT, WIDTH, dtype=torch.float64),
    )


@pytest.mark.parametrize("fraction", [0.77, 0.995])
def test_a_crop_keeps_directions_and_content(fraction):
    """The direction through each pixel of the crop is that of the position it shows."""
    views = make_views()
    crop = center_crop(views, fraction)
    assert crop.images.shape == views.images.shape
    old = views.cameras.intrinsics[:, None, None]
    x, y = crop.images[:, 0] * WIDTH, crop.images[:, 1] * HEIGHT
    seen = torch.stack(
        ((x - old[..., 0, 2]) / old[..., 0, 0], (y - old[..., 1, 2]) / old[..., 1, 1]), -1
    )
    directions = crop.cameras.pixel_directions()[..., :2]
    # The outermost pixels repeat what lies at the edge of the cut.
    assert (seen - directions)[:, 1:-1, 1:-1].abs().max() < 1e-6
    assert (seen - directions).abs().max() < 0.5 / 66
    assert torch.equal(crop.cameras.cam_to_world, views.cameras.cam_to_world)
    assert center_crop(views, 1.0) is views


def test_a_crop_takes_the_nearest_depths_and_masks():
    views, fraction = make_views(), 0.6  # no center on a border between pixels
    crop = center_crop(views, fraction)
    x = (crop.images[0, 0, 20] * WIDTH).floor().long()
    y = (crop.images[0, 1, :, 40] * HEIGHT).floor().long()
    inner = (slice(None), slice(1, -1), slice(1, -1))
    for name in ("depths", "masks", "disparities"):
        maps, found = getattr(views, name), getattr(crop, name)
        assert torch.equal(found[inner], maps[:, y[:, None], x][inner])
    bare = center_crop(replace(views, depths=None, masks=None, disparities=None), fraction)
    assert bare.depths is None and bare.masks is None and bare.disparities is None
    assert torch.equal(bare.images, crop.images)


def test_a_crop_of_stored_images_is_stored():
    views = make_views()
    stored = replace(views, images=(255 * views.images).round().byte())
    crop = center_crop(stored, 0.6)
    assert crop.images.dtype == torch.uint8
    exact = center_crop(stored.decoded(), 0.6).images
    assert (crop.decoded().images - exact).abs().max() < 1.01 / 255


def test_orders_of_inputs_follow_their_probabilities():
    inputs = [3, 5, 8, 13, 21, 34]
    rng = np.random.default_rng(0)
    both = Augmentation(reverse=0.5, shuffle=0.5)
    orders = [both.order(inputs, rng) for _ in range(400)]
    assert all(sorted(order) == inputs for order in orders)
    kinds = [order == inputs for order in orders], [order == inputs[::-1] for order in orders]
    assert all(70 < sum(kind) < 130 for kind in kinds)  # a quarter each
    assert len({tuple(order) for order in orders}) > 100
    assert Augmentation().order(inputs, rng) == inputs
    assert Augmentation(reverse=1.0).order(inputs, rng) == inputs[::-1]


def test_a_task_has_one_exposure():
    views = make_views()
    # Dark enough that nothing is clipped.
    views = replace(views, images=0.1 + 0.3 * views.images)
    exposing = Augmentation(exposure=0.5, white_balance=0.2)
    inputs, targets = exposing.expose(views, views.select([2]), np.random.default_rng(0))
    assert torch.equal(inputs.images[2], targets.images[0])
    gains = inputs.images / views.images
    torch.testing.assert_close(gains, gains[:1, :, :1, :1].expand_as(gains))
    stops = 2.2 * gains[0, :, 0, 0].log2()
    assert len(set(stops.tolist())) == 3
    assert stops.abs().max() < 0.7 and (stops - stops[1]).abs().max() < 0.2
    assert torch.equal(inputs.depths, views.depths)


def test_flicker_and_noise_change_inputs_only():
    views = make_views(12)
    views = replace(views, images=0.1 + 0.3 * views.images)
    for option in ({"flicker": 0.3}, {"noise": 0.02}):
        inputs, targets = Augmentation(**option).expose(views, views, np.random.default_rng(0))
        assert torch.equal(targets.images, views.images)
        assert not torch.equal(inputs.images, views.images)
        again, _ = Augmentation(**option).expose(views, views, np.random.default_rng(0))
        assert torch.equal(inputs.images, again.images)
        if "flicker" in option:
            gains = (inputs.images / views.images).flatten(1)
            assert gains.std(1).max() < 1e-6 and len(gains[:, 0].unique()) == 12
            assert 2.2 * gains.log2().abs().max() < 0.3
    rng = np.random.default_rng(0)
    noises = [
        (Augmentation(noise=0.02).expose(views, views, rng)[0].images - views.images).std()
        for _ in range(20)
    ]
    assert 0 < min(noises) < 0.005 and 0.015 < max(noises) < 0.0205


def test_augmented_images_stay_in_range_and_are_unchanged_by_default():
    views = make_views()
    strong = Augmentation(exposure=1.0, white_balance=1.0, flicker=1.0, noise=1.0)
    for each in strong.expose(views, views, np.random.default_rng(0)):
        each.validate()
    inputs, targets = Augmentation().expose(views, views, np.random.default_rng(0))
    assert torch.equal(inputs.images, views.images) and torch.equal(targets.images, views.images)
