"""Sparse points as a prior, and as the range of a plane sweep."""

from dataclasses import replace
from importlib import import_module

import pytest
import torch

from asysplat.models import PlaneSweepPrior, PointsPrior
from asysplat.models.prior.plane_sweep import plane_sweep
from asysplat.models.prior.prior import UNKNOWN_DISTANCE
from asysplat.scene import Cameras, Views

SIZE = (16, 16)


def make_views(point_depths=None):
    intrinsics = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]).expand(1, 2, 3, 3)
    cameras = Cameras(intrinsics, torch.eye(4).repeat(1, 2, 1, 1), 32, 32)
    return Views(cameras, torch.rand(1, 2, 3, 32, 32), point_depths=point_depths)


def depth(prior, views):
    length = views.cameras.resized(*SIZE).pixel_directions().norm(dim=-1)
    return prior.distance / length


def test_points_spread_to_their_surroundings():
    points = torch.zeros(1, 2, 32, 32)
    points[0, 0, 4, 4], points[0, 0, 5, 5] = 2.0, 6.0  # one block
    points[0, 0, 20, 28] = 5.0
    views = make_views(points)
    prior = PointsPrior()(views, SIZE)
    depths = depth(prior, views)[0, 0]
    assert depths[2, 2].item() == pytest.approx(3, rel=0.05)  # the mean inverse depth's
    assert depths[10, 14].item() == pytest.approx(5, rel=0.05)
    assert depths.min() > 2.9 and depths.max() < 5.1
    assert depths[:6, :6].max() < depths[8:12, 12:].min()
    confidence = prior.confidence[0]
    assert confidence[0, 2, 2:8].tolist() == [1, 0.75, 0.5, 0.25, 0.25, 0]
    assert confidence[1].max() == 0  # the other view has no point,
    assert 2.9 < depth(prior, views)[0, 1].mean() < 5.1  # but the scene's mean depth


def test_views_without_points_are_unknown():
    unknown = PointsPrior()(make_views(), SIZE)
    none_visible = PointsPrior()(make_views(torch.zeros(1, 2, 32, 32)), SIZE)
    for prior in (unknown, none_visible):
        assert prior.confidence.max() == 0
        assert (prior.distance == UNKNOWN_DISTANCE).all()


def test_points_set_the_range_of_a_plane_sweep(monkeypatch):
    """In a view with enough points; the cameras set the range of the other view."""
    given = []

    def spy(images, cameras, ranges, **options):
        given.append(ranges)
        return plane_sweep(images, cameras, backend="reference", ranges=ranges, **options)

    monkeypatch.setattr(import_module(PlaneSweepPrior.__module__), "plane_sweep", spy)
    points = torch.zeros(1, 2, 32, 32)
    points[0, 0, :10, :10] = torch.linspace(2, 4, 100).reshape(10, 10)
    points[0, 0, 20, 20] = 0.01  # a stray point
    points[0, 1, 3, 3:6] = 1.0  # too few
    views = make_views(points)
    views.cameras.cam_to_world[0, 1, 0, 3] = 0.5
    known = PlaneSweepPrior()(views, SIZE)
    assert given[0][0, 0].tolist() == pytest.approx([1 / 6, 3 / 4], rel=0.05)
    assert given[0][0, 1].tolist() == [0, 0]
    unknown = PlaneSweepPrior()(replace(views, point_depths=torch.zeros_like(points)), SIZE)
    cameras = PlaneSweepPrior()(replace(views, point_depths=None), SIZE)
    assert given[2] is None and torch.equal(unknown.distance, cameras.distance)
    assert not torch.equal(known.distance, cameras.distance)


def test_a_plane_sweep_of_one_view_is_unknown():
    views = make_views(torch.full((1, 2, 32, 32), 2.0)).map(lambda tensor: tensor[:, :1])
    prior = PlaneSweepPrior()(views, SIZE)
    assert prior.confidence.max() == 0 and prior.distance.isfinite().all()
