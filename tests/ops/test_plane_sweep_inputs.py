"""The inputs of a plane sweep: shrunk images, their edges, and projections."""

import pytest
import torch
import torch.nn.functional as F
from surfaces import four_cameras, turned

from asysplat.models.prior.plane_sweep import edges, shrink
from asysplat.models.prior.projections import Projections
from asysplat.scene import Cameras


@pytest.mark.parametrize("size", [(12, 18), (6, 9), (4, 6), (12, 6), (5, 7), (1, 1)], ids=str)
def test_smaller_images_are_means_over_areas(size):
    images = torch.rand(2, 3, 12, 18, dtype=torch.float64)
    torch.testing.assert_close(shrink(images, *size), F.interpolate(images, size, mode="area"))


def test_edges_are_color_changes():
    images = torch.zeros(1, 1, 3, 4, 5)
    images[..., 2:] = torch.tensor([0.3, 0.6, 0.9])[:, None, None]
    left, above = edges(images)[0, 0]
    torch.testing.assert_close(left[:, 2], torch.full((4,), 0.6))
    assert left.count_nonzero() == 4 and not above.any()
    torch.testing.assert_close(edges(images.mT)[0, 0, 1], left.T)


def test_projections_for_images_of_any_size():
    """They equal those of resized cameras, and points projected one by one."""
    cameras = turned(four_cameras(), 20)
    cameras = Cameras(
        cameras.intrinsics * torch.tensor([1, 1.2, 1])[:, None], cameras.cam_to_world, 24, 32
    )
    others = torch.tensor([[[1, 2], [3, -1], [0, 3], [2, 1]]])
    matrix = Projections.between(cameras).into(others, 12, 8)
    small = cameras.resized(12, 8)
    torch.testing.assert_close(matrix, Projections.between(small).into(others, 12, 8))
    pixel, depth = torch.tensor([3.5, 7.5, 1], dtype=torch.float64), 2.5
    for view, chosen in enumerate(others[0].tolist()):
        inside = torch.linalg.inv(small.intrinsics[0, view]) @ pixel * depth
        world = small.cam_to_world[0, view] @ torch.cat((inside, torch.ones(1)))
        for k, other in enumerate(chosen):
            there = torch.linalg.inv(small.cam_to_world[0, max(other, 0)]) @ world
            expected = small.intrinsics[0, max(other, 0)] @ there[:3]
            found = matrix[0, view, k] @ torch.cat((pixel, torch.tensor([1 / depth])))
            torch.testing.assert_close(depth * found, expected)
