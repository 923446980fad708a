"""Initial Gaussians: from a prior's depth maps and from sparse points, merged."""

from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.geometry.isotropic import isotropic_gaussians
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.models.prior import Prior
from asysplat.models.prior.prior import FREE_OPACITY
from asysplat.refinement.footprints import footprints
from asysplat.refinement.init import (
    MAX_OPACITY,
    MIN_OPACITY,
    POINT_OPACITY,
    SPREAD,
    gaussians_from_points,
    initial_gaussians,
    merge_cells,
    merge_to_limit,
    sample_colors,
    without_invisible,
)
from asysplat.refinement.settings import DEFAULT
from asysplat.scene import Cameras, Views


def front_views(places=((0.0, 0.0, 0.0),), height=8, width=10, focal=5.0, scale=1.0):
    """Photographs of noise, from cameras that look along z."""
    poses = torch.eye(4).repeat(len(places), 1, 1)
    poses[:, :3, 3] = scale * torch.as_tensor(places)
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = Cameras(matrix.repeat(len(places), 1, 1), poses, height, width)
    return Views(cameras, torch.rand(len(places), 3, height, width))


def colors(gaussians):
    return gaussians.sh[:, 0] * SH_C0 + 0.5


def true_prior(views, opacity=0.5):
    length = views.cameras.pixel_directions().norm(dim=-1)
    distance = (views.depths * length)[None]
    return Prior(distance, torch.full_like(distance, opacity))


def gaussians_from_prior(views, prior):
    placed = prior.gaussians(views.map(lambda tensor: tensor[None]), SPREAD)
    return without_invisible(placed.map(lambda tensor: tensor[0]))


def test_gaussians_of_a_prior_are_at_the_surface_points(small_room):
    gaussians = gaussians_from_prior(small_room, true_prior(small_room)).validate()
    assert gaussians.num_gaussians == small_room.depths.numel()
    for view in range(small_room.num_views):
        part = slice(view * 24 * 32, (view + 1) * 24 * 32)
        pixels, depth, _ = small_room.cameras.select([view]).project(gaussians.means[part])
        torch.testing.assert_close(depth[0], small_room.depths[view].flatten(), rtol=1e-4, atol=0)
        y, x = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
        at = torch.stack((x, y), -1).flatten(0, 1)
        assert (pixels[0] - at).abs().max() <= 1e-3
        expected = small_room.images[view].flatten(1).mT
        torch.testing.assert_close(colors(gaussians)[part], expected, rtol=0, atol=1e-6)
    assert (gaussians.opacities == 0.5).all()
    assert (gaussians.quats == torch.tensor([1.0, 0, 0, 0])).all()


@pytest.mark.parametrize("size", [(4, 5), (8, 10), (20, 11)], ids=str)
def test_a_prior_of_any_size_gives_a_gaussian_a_pixel_in_the_images_colors(size):
    """Of fewer pixels than the photographs, of more, and of such as do not divide them."""
    views = front_views(height=8, width=10)
    distance = torch.full((1, 1, *size), 2.0)
    gaussians = gaussians_from_prior(views, Prior(distance, distance / 4)).validate()
    assert gaussians.num_gaussians == size[0] * size[1]
    if size == (8, 10):  # a focal length of 5: at a distance of 2, a pixel is 2 / 5 wide
        torch.testing.assert_close(gaussians.scales, torch.full((80, 3), SPREAD * 2 / 5))
        torch.testing.assert_close(gaussians.means.norm(dim=-1), torch.full((80,), 2.0))
    if size == (4, 5):
        blocks = views.images[0].unflatten(1, (4, 2)).unflatten(3, (5, 2)).mean((2, 4))
        torch.testing.assert_close(colors(gaussians), blocks.flatten(1).mT, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        colors(gaussians).mean(0), views.images.mean((0, 2, 3)), rtol=0, atol=0.15
    )


def test_pixels_of_a_prior_that_nothing_shows_give_no_gaussian():
    views = front_views(height=8, width=10)
    distance = torch.full((1, 1, 4, 5), 2.0)
    opacity = torch.where(torch.rand(1, 1, 4, 5) < 0.5, FREE_OPACITY, 0.5)
    every = gaussians_from_prior(views, Prior(distance, torch.full_like(distance, 0.5)))
    some = gaussians_from_prior(views, Prior(distance, opacity))
    assert_equal(some, every.keep((opacity > FREE_OPACITY).flatten()))
    none = Prior(distance, torch.full_like(distance, FREE_OPACITY))
    assert torch.equal(gaussians_from_prior(views, none).means, every.means)


def test_footprints_are_the_smallest_over_visible_views():
    views = front_views(places=[(0.0, 0, 0), (0.0, 0, 1), (9.0, 0, 0)])
    cameras = replace(views.cameras, intrinsics=views.cameras.intrinsics.clone())
    cameras.intrinsics[2, :2, :2] *= 100  # the third is fine, and sees nothing of this
    # At depths 2 and 1, a focal length of 5; outside of the second: 0.9 / 0.5 * 5 + 5 = 14 of 10
    # pixels; behind all: 5 from the first, 500 the third's focal length.
    points = torch.tensor([[0.0, 0, 2], [0.9, 0, 1.5], [0.0, 3, -4]])
    behind = (9.0**2 + 3**2 + 4**2) ** 0.5 / 500
    expected = torch.tensor([1 / 5, 1.5 / 5, behind])
    torch.testing.assert_close(footprints(points, cameras), expected)
    found = footprints(torch.zeros(2, 3), front_views().cameras)
    assert (found > 0).all() and (found < 1e-30).all()


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_gaussians_from_points_scale_with_the_scene_unit(scale):
    places = [(0.0, 0, 0), (0.5, 0.1, 0)]
    torch.manual_seed(3)
    views, plain = front_views(places, scale=scale), front_views(places)
    points = torch.rand(50, 3) * torch.tensor([2.0, 2, 3]) + torch.tensor([-1.0, -1, 1])
    expected = gaussians_from_points(points, plain)
    found = gaussians_from_points(points * scale, replace(views, images=plain.images))
    torch.testing.assert_close(found.means / scale, expected.means)
    torch.testing.assert_close(found.scales / scale, expected.scales)
    torch.testing.assert_close(found.sh, expected.sh)
    sizes = footprints(points * scale, views.cameras) / scale
    torch.testing.assert_close(sizes, footprints(points, plain.cameras))


def test_points_have_the_mean_distance_of_neighbors_as_size():
    points = torch.tensor([[0.0, 0, 5], [3.0, 0, 5], [0.0, 4, 5], [0.0, 0, 6], [100.0, 0, 5]])
    gaussians = gaussians_from_points(points, front_views(focal=50.0)).validate()
    torch.testing.assert_close(gaussians.scales[0], torch.full((3,), (3 + 4 + 1) / 3))
    assert (gaussians.opacities == POINT_OPACITY).all()
    for few, size in ((1, 2 / 5), (2, 0.5), (3, 0.5)):  # a pixel, and the mean of the others
        points = torch.tensor([[0.0, 0, 2], [0.0, 0, 2.5], [0.5, 0, 2]])[:few]
        gaussians = gaussians_from_points(points, front_views()).validate()
        torch.testing.assert_close(gaussians.scales[0], torch.full((3,), size))
    for place in ([0.0, 0.0, 2.0], [0.0, 0.0, 0.0]):  # coincident: before a camera, and at it
        points = torch.tensor(place).repeat(6, 1)
        gaussians = gaussians_from_points(points, front_views()).validate()
        expected = footprints(points, front_views().cameras)
        assert torch.equal(gaussians.scales, expected[:, None].repeat(1, 3))


def test_invalid_points_and_gaussians_are_refused():
    bad = torch.tensor([[0.0, 0, 1], [torch.nan, torch.inf, 1]])
    for points, found in ((bad[:0], "got 0 points"), (bad, "2 points with 2 coordinates")):
        with pytest.raises(InputError, match=f"{found}.*give at least one point, and finite"):
            gaussians_from_points(points, front_views())
    gaussians = some(5)
    gaussians.means[3, 1] = torch.nan
    with pytest.raises(InputError, match=r"merge_to_limit's gaussians.means\[3\] holds NaN"):
        merge_to_limit(gaussians, camera(), 1.0, 5)


def test_sampled_colors_are_the_mean_of_unmasked_pixels():
    views = front_views(places=[(0.0, 0, 0), (1.0, 0, 0)])
    points = torch.tensor([[0.5, 0.1, 2.0], [-1.9, -1.5, 2.0], [0.0, 0, -1]])
    # In the first view (6.25, 4.25) and (0.25, 0.25); in the second (3.75, 4.25) and outside.
    one, two = views.images[0, :, 4, 6], views.images[1, :, 4, 3]
    corner, gray = views.images[0, :, 0, 0], torch.full((3,), 0.5)
    expected = torch.stack(((one + two) / 2, corner, gray))
    torch.testing.assert_close(sample_colors(points, views), expected)
    masks = torch.ones(2, 8, 10, dtype=torch.bool)
    masks[1, 4, 3] = masks[0, 0, 0] = False
    found = sample_colors(points, replace(views, masks=masks))
    torch.testing.assert_close(found, torch.stack((one, gray, gray)))


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
    fields = ("means", "quats", "scales", "opacities", "sh")
    assert all(torch.equal(getattr(one, name), getattr(other, name)) for name in fields)


def test_merged_means_and_colors_are_weighted_by_opacity():
    means = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]])
    sizes, opacities = torch.tensor([2.0, 8.0]), torch.tensor([0.6, 0.2])
    both = isotropic_gaussians(means, sizes, opacities, torch.eye(3)[:2])
    one = merge_cells(both, torch.ones(2))
    torch.testing.assert_close(one.means, means[1:] / 4)
    torch.testing.assert_close(one.sh[0], 0.75 * both.sh[0] + 0.25 * both.sh[1])
    torch.testing.assert_close(one.scales, torch.full((1, 3), 2**1.5))  # of their logarithms
    torch.testing.assert_close(one.opacities, torch.tensor([1 - 0.4 * 0.8]))
    small = isotropic_gaussians(means, sizes / 1e4, opacities, torch.eye(3)[:2])
    one = merge_cells(small, torch.tensor([1.0, 1.21]))  # grows to its cell
    torch.testing.assert_close(one.scales, torch.full((1, 3), SPREAD * 1.21**0.25))


@pytest.mark.parametrize("opacity", [1e-30, 0.01, 1.0])
def test_merged_opacities_keep_a_gradient(opacity):
    few = repeated(some(1), 3)
    few.opacities[:] = opacity
    one = merge_cells(few, torch.full((3,), 0.01)).validate()
    expected = min(max(1 - (1 - opacity) ** 3, MIN_OPACITY), MAX_OPACITY)
    torch.testing.assert_close(one.opacities, torch.tensor([expected]))
    for name in ("means", "quats", "scales", "sh"):
        torch.testing.assert_close(getattr(one, name), getattr(few, name)[:1])


@pytest.mark.parametrize("angle", [0.0, 3.1415, 3.1416, 6.28], ids=str)
def test_merging_similar_rotations_takes_their_mean(angle):
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


def test_merging_does_not_depend_on_translation_and_order():
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


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_merging_ends_just_below_the_limit_and_inside_the_scene(scale):
    gaussians = some(200, scale)
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    for most in (1, 2, 50, 199, 200, 1000):
        few = merge_to_limit(gaussians, camera(), 1e-3, most).validate()
        assert min(most, 200) // 5 <= few.num_gaussians <= most, most
        assert few.num_gaussians == 200 or most < 200, most
        inside = (few.means >= low - 1e-5 * scale) & (few.means <= high + 1e-5 * scale)
        assert inside.all(), most


def test_cells_below_the_limit_have_the_pixels_that_are_asked_for():
    gaussians = some(400)
    merged = [merge_to_limit(gaussians, camera(), pixels, 400) for pixels in (0.1, 2.0, 8.0, 64.0)]
    counts = [each.num_gaussians for each in merged]
    assert counts == sorted(counts, reverse=True) and counts[0] > 390 and counts[-1] <= 8
    cells = 8 * footprints(gaussians.means, camera())
    expected = merge_cells(gaussians, cells)
    assert_equal(merged[2], expected)


def test_equal_positions_merge_to_one():
    alike = repeated(some(1), 5)
    assert merge_to_limit(alike, camera(), 1.0, 1).validate().num_gaussians == 1
    alike.means[:] = 0  # at the camera
    assert merge_to_limit(alike, camera(), 1.0, 1).validate().num_gaussians == 1


def test_merging_gives_the_same_bits_on_any_number_of_threads(threads):
    gaussians = some(40_000)
    found = []
    for count in (1, 2, 2):
        threads(count)
        found.append(merge_to_limit(gaussians, camera(), 1.0, 5000))
    assert_equal(found[1], found[0])
    assert_equal(found[2], found[0])


@pytest.mark.parametrize(
    ("init", "message"),
    [
        ("points", "init=points: the scene has no sparse points; choose plane_sweep"),
        ("depth", "init=depth: there are no depth maps; choose plane_sweep or points"),
    ],
)
def test_a_start_from_what_is_lacking_is_refused(init, message):
    with pytest.raises(InputError, match=message):
        initial_gaussians(init, front_views(), DEFAULT.initial_limit)
