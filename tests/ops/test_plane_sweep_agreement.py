"""What views say of each other's depths, and the range that known depths suggest."""

import pytest
import torch
from swept import cameras_at, depth_of_plane, four_cameras, slanted_plane

from asysplat.ops.plane_sweep import plane_sweep, reference
from asysplat.ops.plane_sweep.agreement import Depths, other_views, votes
from asysplat.ops.plane_sweep.cameras import MARGIN, Projections, observed_range

CAMERAS = cameras_at([(0.1 * v, 0.05 * (v % 2), 0.0) for v in range(4)])
INNER = (slice(None), slice(None), slice(4, -4), slice(12, -12))


def wall(halved=()):
    """Inverse depths of a wall, in some views of one at half the distance."""
    inverse = 1 / depth_of_plane(CAMERAS, 2.0)[0]
    for view in halved:
        inverse[:, view] *= 2
    return Depths(inverse, torch.zeros(1, 4, dtype=torch.float64))


def ask_everyone(found, trust=None):
    everyone = other_views(4, 1, torch.device("cpu"))
    projections = Projections.between(CAMERAS).into(everyone, CAMERAS.height, CAMERAS.width)
    return votes(found, everyone, projections, trust)


def test_all_views_find_the_same_wall():
    found = ask_everyone(wall())
    assert (found.same[INNER] == 3).all() and (found.within[INNER] == 3).all()
    assert not found.through.any()
    assert (found.within[:, 0, :, 0] < 3).all()  # cameras on the right do not see the left border
    assert (found.same == found.within).all()


def test_others_see_through_what_is_too_near():
    found = ask_everyone(wall(halved=[3]))
    assert (found.through[:, 3][:, 4:-4, 12:-12] == 3).all() and not found.same[:, 3].any()
    # What is near in the fourth view hides the wall of the others: it says nothing of theirs.
    assert (found.same[:, :3][INNER] == 2).all() and not found.through[:, :3].any()


def test_a_vote_counts_as_far_as_it_is_trusted():
    trust = torch.ones(1, 4, 24, 32, dtype=torch.float64)
    trust[:, 0] = 0.25
    found = ask_everyone(wall(halved=[3]), trust)
    assert (found.through[:, 3][:, 4:-4, 12:-12] == 2.25).all()
    assert (found.same[:, 1][:, 4:-4, 12:-12] == 1.25).all()


def test_chunks_give_the_same_votes(monkeypatch):
    expected = ask_everyone(wall(halved=[1]))
    monkeypatch.setattr(reference, "PLACES", 1)
    for got, there in zip(ask_everyone(wall(halved=[1])), expected, strict=True):
        assert torch.equal(got, there)


@pytest.mark.parametrize("views", [1, 2, 5])
def test_other_views_are_all_but_itself(views):
    others = other_views(views, 2, torch.device("cpu"))
    assert len(others) == 2
    for view, found in enumerate(others[1].tolist()):
        assert sorted(found) == ([v for v in range(views) if v != view] or [-1])


def test_a_range_leaves_outliers_out():
    inverse = torch.cat((torch.linspace(0.5, 2, 98), torch.tensor([1e-4, 1e4]))).expand(1, 2, 100)
    known = torch.ones(1, 2, 100, dtype=torch.bool)
    known[0, 1, 15:] = False  # of the second view too few
    least, greatest = observed_range(inverse, known)[0, 0].tolist()
    assert least == pytest.approx(0.5 / MARGIN, rel=0.05)
    assert greatest == pytest.approx(2 * MARGIN, rel=0.05)
    assert observed_range(inverse, known)[0, 1].tolist() == [0, 0]


def test_the_second_sweep_has_planes_where_surfaces_are():
    """With few planes over all that cameras see the error would be several times as large."""
    cameras = four_cameras(48, 64)
    images, depth = slanted_plane(cameras, distance=6.0)
    found = plane_sweep(images, cameras, planes=16)
    error = (found.inverse_depth * depth - 1).abs()
    assert error.median() < 0.02
