"""Merging: weighted means, opacity of all together, and the limit."""

import pytest
import torch

from asysplat.errors import InputError
from asysplat.refinement.isotropic import footprints, isotropic_gaussians
from asysplat.refinement.merge import MAX_OPACITY, MIN_OPACITY, SPREAD, merge_cells, merge_to_limit
from asysplat.rendering import render
from asysplat.scene import Cameras

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def some(count, scale=1.0):
    """Round Gaussians in a box before the camera below."""
    means = scale * (torch.rand(count, 3) * 4 + torch.tensor([-2.0, -2, 2]))
    sizes = torch.full((count,), 0.1 * scale)
    return isotropic_gaussians(means, sizes, 0.2 + 0.5 * torch.rand(count), torch.rand(count, 3))


def camera(size=32):
    matrix = torch.tensor([[[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]])
    return Cameras(matrix, torch.eye(4)[None], size, size)


def repeated(gaussians, times):
    return gaussians.map(lambda tensor: tensor.repeat(times, *[1] * (tensor.ndim - 1)))


def assert_equal(one, other):
    assert all(torch.equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


def test_equal_gaussians_merge_to_the_opacity_of_both():
    one = some(1)
    two = merge_cells(repeated(one, 2), torch.full((2,), 0.01))
    assert two.num_gaussians == 1
    for name in ("means", "quats", "scales", "sh"):
        torch.testing.assert_close(getattr(two, name), getattr(one, name))
    torch.testing.assert_close(two.opacities, 1 - (1 - one.opacities) ** 2)


def test_the_image_of_doubled_gaussians_stays():
    gaussians = some(60)
    gaussians.opacities.mul_(0.3)
    twice, cells = repeated(gaussians, 2), torch.full((120,), 1e-4)
    once = merge_cells(twice, cells)
    assert once.num_gaussians == 60
    twice, once, half = (render(each, camera()).image for each in (twice, once, gaussians))
    # Where two lie over one another, alpha is not quite that of one with both opacities.
    assert (once - twice).abs().mean() <= 0.2 * (half - twice).abs().mean()


def test_means_are_weighted_by_opacity():
    means = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]])
    sizes, opacities = torch.tensor([2.0, 8.0]), torch.tensor([0.6, 0.2])
    both = isotropic_gaussians(means, sizes, opacities, torch.eye(3)[:2])
    one = merge_cells(both, torch.ones(2))
    torch.testing.assert_close(one.means, means[1:] / 4)
    torch.testing.assert_close(one.sh[0], 0.75 * both.sh[0] + 0.25 * both.sh[1])
    torch.testing.assert_close(one.scales, torch.full((1, 3), 2**1.5))  # of their logarithms
    torch.testing.assert_close(one.opacities, torch.tensor([1 - 0.4 * 0.8]))


def test_merged_gaussians_cover_their_cell():
    half = torch.full((2,), 0.5)
    both = isotropic_gaussians(torch.zeros(2, 3), half / 500, half, torch.zeros(2, 3))
    one = merge_cells(both, torch.tensor([1.0, 1.21]))
    torch.testing.assert_close(one.scales, torch.full((1, 3), SPREAD * 1.1))


@pytest.mark.parametrize("opacity", [1e-30, 1e-8, 0.01, 0.9, 1.0])
def test_opacities_keep_a_gradient(opacity):
    few = repeated(some(1), 3)
    few.opacities[:] = opacity
    one = merge_cells(few, torch.ones(3)).validate()
    exact = 1 - (1 - opacity) ** 3
    expected = min(max(exact, MIN_OPACITY), MAX_OPACITY)
    torch.testing.assert_close(one.opacities, torch.tensor([expected]))
    torch.testing.assert_close(one.means, few.means[:1])


def test_a_transparent_gaussian_changes_nothing():
    both = some(2)
    both.means[:] = 0
    both.opacities[1] = 1e-7
    found = merge_cells(both, torch.ones(2)).sh[0]
    torch.testing.assert_close(found, both.sh[0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 3.1415, 3.1416, 3.2, 6.28], ids=str)
def test_the_mean_of_similar_rotations(angle):
    """Half a turn has w = 0, on both sides of which w changes its sign; q and -q are one turn."""
    angles = torch.tensor([angle - 0.01, angle, angle + 0.01])
    both = repeated(some(1), 3)
    both.quats[:] = torch.stack((angles.div(2).cos(), *2 * [0 * angles], angles.div(2).sin()), -1)
    both.quats[1] *= -3
    found = merge_cells(both, torch.ones(3)).quats[0]
    torch.testing.assert_close(found.norm(), torch.tensor(1.0))
    expected = torch.tensor([angle / 2]).cos(), torch.tensor([angle / 2]).sin()
    assert (found[0] * expected[0] + found[3] * expected[1]).abs() >= 1 - 1e-5


def test_cells_are_powers_of_2_and_tile_the_space():
    """Along x, from the least: sides of 0.8 and 1.4 are of 1, those of 1.5 and 2.8 of 2."""
    x = torch.arange(8) + 0.5
    means = torch.stack((x, 0 * x, 0 * x), -1)
    line = isotropic_gaussians(means, 0.1 * torch.ones(8), 0.5 * torch.ones(8), torch.zeros(8, 3))
    for side, count in ((0.4, 8), (0.8, 8), (1.4, 8), (1.5, 4), (2.8, 4), (3.0, 2), (6.0, 1)):
        assert merge_cells(line, torch.full((8,), side)).num_gaussians == count, side
    mixed = merge_cells(line, torch.tensor([2.0, 2, 1, 1, 2, 2, 1, 2]))
    assert sorted(mixed.means[:, 0].tolist()) == [1, 2.5, 3.5, 5, 6.5, 7.5]


def test_invariance_to_translation_and_order():
    gaussians, cells, order = some(300), torch.rand(300) + 0.1, torch.randperm(300)
    gaussians.means[:] = (gaussians.means * 1024).round() / 1024  # so that the sum is exact
    expected = merge_cells(gaussians, cells)
    found = merge_cells(gaussians.map(lambda tensor: tensor[order]), cells[order])
    torch.testing.assert_close(found.means, expected.means)
    shift = torch.tensor([1024.0, -512, 64])
    gaussians.means.add_(shift)
    found = merge_cells(gaussians, cells)
    assert 50 < found.num_gaussians == expected.num_gaussians < 290
    torch.testing.assert_close(found.means - shift, expected.means, rtol=0, atol=1e-3)


def test_cell_ids_do_not_overflow():
    """A point at a camera has a cell of next to nothing, and its place a number beyond 2^63."""
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1, 0], [1.0, 1, 1e-30]])
    few = isotropic_gaussians(means, torch.ones(4), torch.full((4,), 0.5), torch.zeros(4, 3))
    assert merge_cells(few, torch.full((4,), 1e-37)).num_gaussians == 4
    assert merge_cells(few, torch.tensor([1e-37, 1e-37, 1.0, 1.0])).num_gaussians == 3


@pytest.mark.parametrize("most", [1, 2, 7, 50, 199, 200, 1000])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_limit(most, scale):
    gaussians = some(200, scale)
    few = merge_to_limit(gaussians, camera(), 1e-3, most).validate()
    assert few.num_gaussians <= most
    assert few.num_gaussians >= min(most, 200) // 5
    assert few.num_gaussians == 200 or most < 200
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    assert ((few.means >= low - 1e-5 * scale) & (few.means <= high + 1e-5 * scale)).all()


def test_the_size_of_cells_below_the_limit():
    gaussians = some(400)
    merged = [merge_to_limit(gaussians, camera(), pixels, 400) for pixels in (0.1, 2.0, 8.0, 64.0)]
    counts = [each.num_gaussians for each in merged]
    assert counts == sorted(counts, reverse=True) and counts[0] > 390 and counts[-1] <= 8
    cells = 8 * footprints(gaussians.means, camera())
    expected = merge_cells(gaussians, cells)
    assert_equal(merged[2], expected)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_equal_positions_merge_to_one(count):
    alike = repeated(some(1), count)
    assert merge_to_limit(alike, camera(), 1.0, 1).validate().num_gaussians == 1
    alike.means[:] = 0  # at the camera
    assert merge_to_limit(alike, camera(), 1.0, 1).validate().num_gaussians == 1


def test_the_same_bits_again(threads):
    gaussians = some(40_000)
    threads(1)
    first = merge_to_limit(gaussians, camera(), 1.0, 5000)
    for _ in range(2):
        threads(2)
        assert_equal(merge_to_limit(gaussians, camera(), 1.0, 5000), first)


def test_nan_is_refused():
    gaussians = some(5)
    gaussians.means[3, 1] = torch.nan
    with pytest.raises(InputError, match=r"merge_to_limit's gaussians.means\[3\] holds NaN"):
        merge_to_limit(gaussians, camera(), 1.0, 5)
