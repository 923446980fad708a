"""The parts of a plane sweep: the consistency check between views, the range of known depths,
smaller images, their edges, and projections."""

import pytest
import torch
import torch.nn.functional as F
from surfaces import cameras_at, depth_of_plane, four_cameras, slanted_plane, turned

from asysplat.models.prior import Prior
from asysplat.models.prior.fill import color_edges
from asysplat.models.prior.plane_sweep import plane_sweep, shrink
from asysplat.models.prior.prior import (
    FREE_OPACITY,
    DepthEstimate,
    count_votes,
    in_free_space,
    other_views,
)
from asysplat.models.prior.projections import (
    MARGIN,
    PairwiseProjections,
    inverse_depth_range,
    observed_range,
)
from asysplat.ops.plane_sweep import load_backend, reference
from asysplat.scene import Cameras, Views

CAMERAS = cameras_at([(0.1 * v, 0.05 * (v % 2), 0.0) for v in range(4)])
INNER = (slice(None), slice(None), slice(4, -4), slice(12, -12))


def wall(halved=(), trust=None):
    """The inverse depths of a wall, trust in them, and all other views; some are twice as near."""
    inverse = 1 / depth_of_plane(CAMERAS, 2.0)[0]
    for view in halved:
        inverse[:, view] *= 2
    others = other_views(4, 1, torch.device("cpu"))
    projections = PairwiseProjections.from_cameras(CAMERAS).matrices(
        others, CAMERAS.height, CAMERAS.width
    )
    trust = torch.ones_like(inverse) if trust is None else trust
    return inverse, trust, others, projections


def check_wall(halved=(), trust=None):
    inverse, *rest = wall(halved, trust)
    steps = torch.zeros(1, 4, dtype=torch.float64)
    return load_backend("auto", inverse).consistency(inverse, steps, *rest)


def opacity(inverse, votes, confidence):
    views = Views(CAMERAS, torch.rand(1, 4, 3, CAMERAS.height, CAMERAS.width))
    estimate = DepthEstimate(inverse, confidence * torch.ones_like(inverse), votes)
    return Prior.from_estimate(estimate, views, inverse.shape[-2:]).opacity


def test_all_views_agree_on_a_wall_and_contradict_a_depth_that_is_too_near(monkeypatch):
    found = check_wall()
    assert (found.agreeing[INNER] == 3).all() and (found.containing[INNER] == 3).all()
    assert not found.contradicting.any()
    assert (found.containing[:, 0, :, 0] < 3).all()  # the left border is outside other images
    assert (found.agreeing == found.containing).all()

    trust = torch.ones(1, 4, 24, 32, dtype=torch.float64)
    found = check_wall(halved=[3], trust=trust)
    assert (found.contradicting[:, 3][:, 4:-4, 12:-12] == 3).all()
    assert not found.agreeing[:, 3].any()
    # The near surface of the fourth view occludes the wall: it does not contradict the others.
    assert (found.occluding[:, :3][INNER] == 1).all()
    assert (found.agreeing[:, :3][INNER] == 2).all() and not found.contradicting[:, :3].any()
    monkeypatch.setattr(reference, "PIXELS_AT_ONCE", 1)
    assert all(map(torch.equal, check_wall(halved=[3], trust=trust), found))
    trust[:, 0] = 0.25  # votes count as much as they are trusted
    found = check_wall(halved=[3], trust=trust)
    assert (found.contradicting[:, 3][:, 4:-4, 12:-12] == 2.25).all()
    assert (found.agreeing[:, 1][:, 4:-4, 12:-12] == 1.25).all()


def test_what_three_views_see_through_is_in_free_space_and_hardly_opaque():
    inverse, trust, others, projections = wall(halved=[3])
    votes = count_votes(inverse, trust, others, projections)
    free = in_free_space(votes)
    assert free[:, 3, 4:-4, 12:-12].all() and not free[:, :3].any()
    opacities = opacity(inverse, votes, confidence=1)
    assert (opacities[free] == FREE_OPACITY).all() and opacities[~free].min() > 0.4
    # What one other view denies, or none sees, is kept.
    for few in ([[1, -1, -1]] * 3 + [[0, -1, -1]], [[-1, -1, -1]] * 4):
        votes = count_votes(inverse, trust, torch.tensor([few]), projections)
        assert not in_free_space(votes).any()


def test_views_from_which_a_point_is_hidden_leave_it_its_opacity():
    """The fourth view sees a surface in front of the wall, so the wall's other views share it."""
    inverse, *rest = wall(halved=[3])
    votes, clear = count_votes(inverse, *rest), count_votes(*wall())
    assert (votes.occluding[:, :3][INNER] == 1).all() and not votes.occluding[:, 3].any()
    hidden, seen = (opacity(inverse, each, confidence=0) for each in (votes, clear))
    assert (hidden > seen)[:, :3][INNER].all()


def test_no_neighbor_sees_no_depth():
    """An index of -1 is not the last view, nor the view itself where that is the last."""
    cameras = cameras_at([(0.1 * v, 0.0, 0.0) for v in range(3)])
    projections = PairwiseProjections.from_cameras(cameras)
    padded = torch.tensor([[[1, -1, -1], [0, -1, -1], [1, -1, -1]]])
    found, expected = (
        inverse_depth_range(cameras, projections, chosen) for chosen in (padded, padded[..., :1])
    )
    assert torch.equal(found, expected) and (found[..., 1] > 0).all()


def test_a_range_ignores_outliers():
    inverse = torch.cat((torch.linspace(0.5, 2, 98), torch.tensor([1e-4, 1e4]))).expand(1, 2, 100)
    known = torch.ones(1, 2, 100, dtype=torch.bool)
    known[0, 1, 15:] = False  # too few in the second view
    least, greatest = observed_range(inverse, known)[0, 0].tolist()
    assert least == pytest.approx(0.5 / MARGIN, rel=0.05)
    assert greatest == pytest.approx(2 * MARGIN, rel=0.05)
    assert observed_range(inverse, known)[0, 1].tolist() == [0, 0]


def test_the_second_sweep_has_planes_where_surfaces_are():
    """With few planes over the cameras' whole range the error would be several times as large."""
    cameras = four_cameras(48, 64)
    images, depth = slanted_plane(cameras, distance=6.0)
    found = plane_sweep(images, cameras, planes=16)
    error = (found.inverse_depth * depth - 1).abs()
    assert error.median() < 0.02


def test_smaller_images_are_means_over_areas_and_edges_are_color_changes():
    images = torch.rand(2, 3, 12, 18, dtype=torch.float64)
    for size in ((12, 18), (6, 9), (5, 7), (1, 1)):
        torch.testing.assert_close(shrink(images, *size), F.interpolate(images, size, mode="area"))
    images = torch.zeros(1, 1, 3, 4, 5)
    images[..., 2:] = torch.tensor([0.3, 0.6, 0.9])[:, None, None]
    left, above = color_edges(images)[0, 0]
    torch.testing.assert_close(left[:, 2], torch.full((4,), 0.6))
    assert left.count_nonzero() == 4 and not above.any()
    torch.testing.assert_close(color_edges(images.mT)[0, 0, 1], left.T)


def test_projections_for_images_of_any_size():
    """They are those of points that resized cameras project one by one."""
    cameras = turned(four_cameras(), 20)
    cameras = Cameras(
        cameras.intrinsics * torch.tensor([1, 1.2, 1])[:, None], cameras.cam_to_world, 24, 32
    )
    others = torch.tensor([[[1, 2], [3, -1], [0, 3], [2, 1]]])
    matrix = PairwiseProjections.from_cameras(cameras).matrices(others, 12, 8)
    small = cameras.resized(12, 8)
    pixel, depth = torch.tensor([3.5, 7.5, 1], dtype=torch.float64), 2.5
    for view, chosen in enumerate(others[0].tolist()):
        inside = torch.linalg.inv(small.intrinsics[0, view]) @ pixel * depth
        world = small.cam_to_world[0, view] @ torch.cat((inside, torch.ones(1)))
        for k, other in enumerate(chosen):
            there = torch.linalg.inv(small.cam_to_world[0, max(other, 0)]) @ world
            expected = small.intrinsics[0, max(other, 0)] @ there[:3]
            found = matrix[0, view, k] @ torch.cat((pixel, torch.tensor([1 / depth])))
            torch.testing.assert_close(depth * found, expected)
