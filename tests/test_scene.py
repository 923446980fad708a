"""The values that pass between the rooms: shapes, numbers, and what they refuse."""

import re
import subprocess
import sys
import textwrap
from dataclasses import fields, replace

import pytest
import torch

from asysplat import Cameras, Gaussians, Views
from asysplat.errors import InputError
from asysplat.scene import encode


def cameras(views=2, height=4, width=6):
    intrinsics = torch.tensor([[5.0, 0, 3.0], [0, 6.0, 2.0], [0, 0, 1]]).repeat(views, 1, 1)
    return Cameras(intrinsics, torch.eye(4).repeat(views, 1, 1), height, width)


def gaussians(count=5):
    return Gaussians(
        torch.randn(count, 3),
        torch.randn(count, 4),
        torch.rand(count, 3) + 0.1,
        torch.full((count,), 0.5),
        torch.randn(count, 4, 3),
    )


def test_rays_go_through_pixel_centers():
    origins, directions = cameras().rays()
    assert origins.shape == directions.shape == (2, 4, 6, 3)
    expected = torch.tensor([(0.5 - 3) / 5, (3.5 - 2) / 6, 1.0])
    torch.testing.assert_close(directions[0, 3, 0], expected / expected.norm())


def test_rays_of_resized_cameras_are_those_between_the_pixels():
    _, fine = cameras().rays()
    _, coarse = cameras().resized(2, 3).rays()
    block = (fine / fine[..., 2:])[:, :2, :2].mean((1, 2))
    torch.testing.assert_close((coarse / coarse[..., 2:])[:, 0, 0], block)


def test_select_and_stack_and_to():
    views = Views(
        cameras(3),
        torch.rand(3, 3, 4, 6),
        torch.rand(3, 4, 6),
        disparities=torch.rand(3, 4, 6),
    )
    picked = views.select([2, 0])
    assert torch.equal(picked.disparities, views.disparities[[2, 0]])
    assert torch.equal(picked.images[0], views.images[2])
    assert torch.equal(picked.depths[1], views.depths[0])
    batch = Views.stack([views, picked.select([0, 1, 1])])
    assert batch.images.shape == (2, 3, 3, 4, 6)
    assert batch.to(torch.float64).cameras.intrinsics.dtype == torch.float64


def test_joined_views_have_every_field_of_both():
    plain = Views(cameras(2), torch.rand(2, 3, 4, 6))
    masks, depths = torch.rand(3, 4, 6) < 0.5, torch.rand(3, 4, 6)
    others = Views(cameras(3), torch.rand(3, 3, 4, 6), depths, masks)
    both = plain.join(others)
    assert both.validate().num_views == 5 and both.alphas is None
    assert both.masks[:2].all() and torch.equal(both.masks[2:], masks)
    assert not both.depths[:2].any() and torch.equal(both.depths[2:], depths)
    assert torch.equal(both.select([4]).images, others.images[2:])
    assert both.resized(2, 3).join(both.resized(2, 3)).num_views == 10


def test_views_of_another_size_keep_every_field():
    maps = {field.name: torch.rand(2, 3, 4, 6) for field in fields(Views)}
    maps |= {"images": torch.rand(2, 3, 3, 4, 6), "masks": torch.rand(2, 3, 4, 6) > 0.2}
    views = Views(**maps | {"cameras": Cameras.stack([cameras(3)] * 2)})
    half = views.resized(2, 3)

    def blocks(maps):
        return maps.unflatten(-2, (2, 2)).unflatten(-1, (3, 2))

    torch.testing.assert_close(half.images, blocks(views.images).mean((-3, -1)))
    assert torch.equal(half.masks, blocks(views.masks).all(-1).all(-2))
    assert all(getattr(half, name) is not None for name in maps)
    assert half.depths.unique().numel() == 2 * 3 * 2 * 3
    for batch in range(2):
        alone = views.map(lambda values: values[batch]).resized(2, 3)  # noqa: B023
        assert torch.equal(alone.images, half.images[batch])
        assert torch.equal(alone.masks, half.masks[batch])


def test_stored_views_are_decoded_ones_in_a_fourth_of_the_memory():
    """Whatever is computed of views does not depend on how their images are stored."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(256, (5, 3, 6, 8), generator=generator, dtype=torch.uint8)
    masks, alphas = torch.rand(2, 5, 6, 8, generator=generator)
    stored = Views(cameras(5, 6, 8), images, masks=masks > 0.3, alphas=(alphas - 0.2).clamp(0, 1))
    decoded = stored.decoded()
    assert torch.equal(encode(decoded.images, torch.uint8), images)
    assert torch.equal(stored.one(2).images, decoded.images[2:3])
    assert torch.equal(stored.masked(decoded.images), decoded.images)
    for each in (stored, replace(stored, masks=None)):
        torch.testing.assert_close(each.mean_color(), each.decoded().mean_color())
    nearest = stored.nearest_images(stored.cameras)
    assert torch.equal(nearest, decoded.nearest_images(stored.cameras))
    half_step = {"atol": 0.501 / 255, "rtol": 0.0}
    white, green = torch.ones(3), torch.tensor([0.0, 1.0, 0.0])
    for of in (lambda views: views.resized(3, 4), lambda views: views.over(white, green)):
        changed, expected = of(stored), of(decoded)
        assert changed.images.dtype == torch.uint8
        torch.testing.assert_close(changed.decoded().images, expected.images, **half_step)
    for first, second in ((stored, decoded), (decoded, stored)):
        joined = first.join(second)
        assert joined.images.dtype == first.images.dtype
        assert torch.equal(joined.decoded().images, torch.cat(2 * [decoded.images]))


def test_a_field_that_one_scene_lacks_is_dropped_from_the_batch():
    images = torch.rand(2, 3, 4, 6)
    with_depth = Views(cameras(), images, torch.rand(2, 4, 6))
    assert Views.stack([with_depth, Views(cameras(), images)]).depths is None


def test_scenes_of_different_sizes_do_not_stack():
    with pytest.raises(InputError, match="height"):
        Cameras.stack([cameras(height=4), cameras(height=8)])


def test_project_gives_pixels_depth_and_whether_they_are_inside():
    intrinsics = torch.tensor([[5.0, 0, 5.0], [0, 5.0, 4.0], [0, 0, 1]]).repeat(2, 1, 1)
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = 1
    points = torch.tensor([[0.0, 0, 2], [1.0, -1, 4], [0.0, 0, -2], [-3.0, 0, 2], [0.0, 0, 0]])
    pixels, depth, inside = Cameras(intrinsics, poses, 8, 10).project(points)
    # x = 5 X / Z + 5, y = 5 Y / Z + 4
    torch.testing.assert_close(pixels[0, :2], torch.tensor([[5.0, 4], [6.25, 2.75]]))
    torch.testing.assert_close(pixels[1, :2], torch.tensor([[2.5, 4], [5.0, 2.75]]))
    assert depth.tolist() == [[2, 4, -2, 2, 0]] * 2
    assert inside.tolist() == [[True, True, False, False, False]] * 2


def test_project_inverts_rays(make_scene):
    _, views = make_scene(views=3)
    origins, directions = views.rays()
    pixels, _, inside = views.project((origins + 2 * directions)[1].flatten(0, 1))
    y, x = torch.meshgrid(torch.arange(13) + 0.5, torch.arange(17) + 0.5, indexing="ij")
    torch.testing.assert_close(pixels[1], torch.stack((x, y), -1).flatten(0, 1).double())
    assert inside[1].all()


def test_gaussians_keep_and_scale():
    scene = gaussians()
    right = scene.means[:, 0] > 0
    assert torch.equal(scene.keep(right).sh, scene.sh[right])
    doubled = scene.scale_by(2.0)
    torch.testing.assert_close(doubled.means, 2 * scene.means)
    torch.testing.assert_close(doubled.scales, 2 * scene.scales)
    assert torch.equal(doubled.quats, scene.quats)


BAD_CAMERAS = {
    "intrinsics[1] has a focal length <= 0": lambda views: views.intrinsics[1, 1, 1].fill_(0.0),
    "cam_to_world[1] has a rotation that is not orthonormal": (
        lambda views: views.cam_to_world[1, 0, 0].fill_(2.0)
    ),
    "with determinant +1": lambda views: views.cam_to_world[1, 0, 0].fill_(-1.0),
    "cam_to_world[1] has a last row": lambda views: views.cam_to_world[1, 3, 0].fill_(1.0),
}


@pytest.mark.parametrize("complaint", BAD_CAMERAS)
def test_bad_cameras_name_field_and_view(complaint):
    views = cameras()
    BAD_CAMERAS[complaint](views)
    with pytest.raises(InputError, match=re.escape(complaint)):
        views.validate()


def test_images_of_another_shape_or_range_are_refused():
    images = torch.rand(2, 3, 4, 6)
    with pytest.raises(InputError, match="expected \\(2, 3, 4, 6\\)"):
        Views(cameras(), images[..., :5])
    images[1, 0, 0, 0] = 255
    with pytest.raises(InputError, match=r"images\[1\].*255"):
        Views(cameras(), images).validate()


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [("scales", 0.0, "exp"), ("opacities", 1.5, "sigmoid"), ("means", float("inf"), "infinity")],
)
def test_gaussians_out_of_range_are_named(field, value, complaint):
    scene = gaussians()
    getattr(scene, field)[3] = value
    with pytest.raises(InputError, match=rf"{field}\[3\].*{complaint}"):
        scene.validate()


def test_unusable_number_of_sh_coefficients():
    scene = gaussians()
    with pytest.raises(InputError, match="1, 4, 9 or 16"):
        Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, torch.rand(5, 5, 3))


def test_masked_pixels_are_neither_error_nor_gradient():
    mask = torch.rand(2, 4, 6) > 0.5
    views = Views(cameras(), torch.rand(2, 3, 4, 6), masks=mask)
    rendered = torch.rand(2, 3, 4, 6, requires_grad=True)
    (views.masked(rendered) - views.images).square().sum().backward()
    assert torch.equal((rendered.grad != 0).all(1), mask)
    assert torch.equal((rendered.grad == 0).all(1), ~mask)


FROM_OUTSIDE = {
    "Views(cameras, images.numpy())": "is ndarray: give a torch tensor",
    "Views(cameras, 255 * images + 2)": "divide 8-bit images by 255",
    "Views(cameras.resized(100, 100).resized(4, 4), images)": "",
    "Views(replace(cameras, intrinsics=cameras.intrinsics / 400), images)": "normalized ones",
}


@pytest.mark.medium
def test_views_from_outside_are_checked(repository):
    """In a process without the types' checks of the tests."""
    script = """
        import sys, torch
        from dataclasses import replace
        from asysplat import Cameras, Views
        from asysplat.errors import InputError
        matrix = torch.tensor([[5.0, 0, 2], [0, 5, 2], [0, 0, 1]])
        cameras, images = Cameras(matrix[None], torch.eye(4)[None], 4, 4), torch.rand(1, 3, 4, 4)
        for text in sys.argv[1:]:
            try:
                eval(text).validate()
                print()
            except InputError as error:
                print(error)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), *FROM_OUTSIDE]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=100)
    sentences = done.stdout.splitlines()
    assert len(sentences) == len(FROM_OUTSIDE), done.stderr
    for sentence, expected in zip(sentences, FROM_OUTSIDE.values(), strict=True):
        assert expected in sentence and bool(expected) == bool(sentence)
