"""The cameras of a reconstruction's video."""

import re
from dataclasses import replace

import pytest
import torch
from omegaconf import OmegaConf

from asysplat.data import ProceduralScene
from asysplat.data.normalize import Normalization
from asysplat.data.photographs import Photographs
from asysplat.errors import InputError
from asysplat.reconstruct.video import _find_view, check_video, subject, video_cameras


@pytest.fixture(scope="module")
def views():
    return ProceduralScene(seed=7, height=48, width=48, num_images=16).views(range(16))


def test_the_subject_of_an_orbit_is_where_the_views_see_a_surface(make_scene):
    scene, cameras = make_scene(count=400, views=5, dtype=torch.float32)
    plane = torch.rand(400, 2, generator=torch.Generator().manual_seed(0)) * 6 - 3
    means = torch.cat((plane, torch.full((400, 1), 2.5)), -1)
    opaque = torch.full_like(scene.opacities, 0.99)
    flat = replace(scene, means=means, scales=torch.full_like(means, 0.3), opacities=opaque)
    assert subject(flat, cameras)[2].item() == pytest.approx(2.5, abs=0.2)


@pytest.fixture
def video(views, make_scene):
    """The cameras of a video with these options, of photographs of which two are held out."""
    parts = [[view for view in range(16) if view % 8], [0, 8]]
    files = [[f"scene/images/IMG_{view:02}.jpg" for view in part] for part in parts]
    frame = Normalization(torch.eye(4, dtype=torch.float64), 1.0)
    scene, _ = make_scene(dtype=torch.float32)
    photographs = Photographs(
        "scene", *map(views.select, parts), *files, frame, None, torch.zeros(3)
    )

    def cameras(alphas=None, **options):
        shown = replace(photographs, inputs=replace(photographs.inputs, alphas=alphas))
        options = {"path": "own", "height": None, "seconds": 1, "fps": 12} | options
        return video_cameras(OmegaConf.create(options), shown, scene)

    return cameras


@pytest.mark.parametrize("path", ["own", "orbit"])
def test_a_video_of_another_height_has_the_field_of_view_and_even_sides(video, path):
    small = video(path=path)
    for height, size in ((None, (48, 48)), (540, (540, 540)), (97, (96, 96)), (2, (2, 2))):
        made = video(path=path, height=height)
        assert (made.height, made.width) == size and made.num_views == 12
        scale = torch.tensor([size[1] / 48, size[0] / 48, 1.0])[:, None]
        torch.testing.assert_close(made.intrinsics, scale * small.intrinsics)
        assert torch.equal(made.cam_to_world, small.cam_to_world)


def test_an_orbit_goes_around_an_object(video, make_scene):
    middle = make_scene(dtype=torch.float32)[0].means.median(0).values
    path = video(alphas=torch.ones(14, 48, 48), path="orbit")
    pixels, depths, _ = path.project(middle[None])
    assert (depths > 0).all() and (pixels - 24).abs().max() < 1e-3


def test_a_video_passes_the_photographs_in_the_order_of_their_names(video, views):
    names = ("IMG_08.jpg", "scene/images/IMG_01.jpg", "IMG_14.jpg")
    made = video(path=names, fps=200)
    chosen = views.cameras.select([8, 1, 14]).centers
    distances = torch.cdist(chosen, made.centers)
    assert (distances.min(1).values < 0.06 * torch.cdist(chosen, chosen).max()).all()
    order = distances.argmin(1)
    assert (order.diff() > 0).all() and order[0] == 0 and order[-1] == 199


@pytest.mark.parametrize(
    ("files", "name", "message"),
    [
        (
            [f"a/IMG_{view}.jpg" for view in range(5)],
            "IMG_31.jpg",
            r"none of the 5 photographs used .* name one of them, such as IMG_3\.jpg, IMG_1",
        ),
        (
            ["a/left/1.jpg", "a/right/1.jpg", "a/left/2.jpg"],
            "1.jpg",
            r"1\.jpg is the name of 2 of .* such as a/left/1\.jpg, a/right/1\.jpg\.",
        ),
    ],
)
def test_names_of_no_photograph_or_of_several_are_refused(files, name, message):
    with pytest.raises(InputError, match=message):
        _find_view(name, files)


OPTIONS = [
    ("path", "spiral", "video.path=spiral should be 'own', 'orbit' or 'none'."),
    ("height", 0, "video.height=0 should be greater than or equal to 2."),
    ("fps", 0, "video.fps=0 should be greater than 0."),
]


@pytest.mark.parametrize(("name", "value", "message"), OPTIONS)
def test_options_out_of_range_are_named(name, value, message):
    options = {"path": "own", "height": None, "seconds": 5, "fps": 30}
    check_video(OmegaConf.create(options))
    with pytest.raises(InputError, match=re.escape(message)):
        check_video(OmegaConf.create(options | {name: value}))
