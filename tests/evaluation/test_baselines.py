import math

import torch

from asysplat.evaluation.metrics import mean_color_images, nearest_view_images
from asysplat.scene import Cameras, Views


def make_views(positions, yaws_in_degrees, images=None):
    """Level cameras: yaw 0 looks along +z, positive yaw turns toward +x."""
    poses = []
    for position, yaw in zip(positions, yaws_in_degrees, strict=True):
        c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        pose[:3, 3] = torch.tensor(position, dtype=torch.float32)
        poses.append(pose)
    count = len(poses)
    if images is None:  # view i is filled with i / 10
        images = torch.arange(count)[:, None, None, None].expand(count, 3, 2, 3) / 10
    cameras = Cameras(torch.eye(3).expand(count, 3, 3), torch.stack(poses), 2, 3)
    return Views(cameras, images)


def nearest(inputs, targets):
    return (nearest_view_images(inputs, targets)[..., 0, 0, 0] * 10).round().int().tolist()


def test_mean_color_is_of_all_inputs_of_the_scene():
    images = torch.zeros(2, 3, 2, 3)
    images[0, 0], images[1, 1, 0] = 1.0, 1.0
    a = make_views([[0, 0, 0], [1, 0, 0]], [0, 0], images)
    b = make_views([[0, 0, 0], [1, 0, 0]], [0, 0])
    inputs = Views.stack([a, b])
    targets = Views.stack([make_views([[0, 0, 0]] * 3, [0] * 3)] * 2)
    found = mean_color_images(inputs, targets)
    assert found.shape == (2, 3, 3, 2, 3)
    expected = torch.tensor([[0.5, 0.25, 0.0], [0.05, 0.05, 0.05]])
    torch.testing.assert_close(found, expected[:, None, :, None, None].expand_as(found))


def test_the_nearest_view_is_that_of_the_nearest_center_then_of_the_direction():
    inputs = make_views([[0, 0, 0], [4, 0, 0], [4, 0, 0]], [0, 0, 90])
    targets = make_views([[1, 0, 0], [3, 0, 0], [3, 0, 0], [4, 9, 0]], [0, 10, 80, 50])
    assert nearest(inputs, targets) == [0, 1, 2, 2]
    coincident = make_views([[5, 0, 0]] * 3, [0, 60, 120])
    assert nearest(coincident, make_views([[0, 0, 0], [0, 7, 0]], [100, 20])) == [2, 0]
    single = make_views([[5, 0, 0]], [0])
    assert nearest(single, make_views([[0, 0, 0]], [180])) == [0]


def test_the_nearest_view_weighs_distance_by_extent_and_angle_by_pi():
    # Spread 10. Input 0: 4/10 + 0. Input 1: 0 + yaw/180: the winner changes at a yaw of 72.
    target = make_views([[4, 0, 0]], [0])
    assert nearest(make_views([[0, 0, 0], [4, 0, 0], [10, 0, 0]], [0, 71, 180]), target) == [1]
    assert nearest(make_views([[0, 0, 0], [4, 0, 0], [10, 0, 0]], [0, 73, 180]), target) == [0]


def test_the_nearest_views_of_a_batch_are_those_of_each_scene():
    def scenes(count):
        views = [
            make_views(torch.randn(count, 3).tolist(), (360 * torch.rand(count)).tolist())
            for _ in range(4)
        ]
        return views, Views.stack(views)

    (inputs, stacked_inputs), (targets, stacked_targets) = scenes(5), scenes(3)
    together = nearest_view_images(stacked_inputs, stacked_targets)
    for scene in range(4):
        assert torch.equal(together[scene], nearest_view_images(inputs[scene], targets[scene]))
