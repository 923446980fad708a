"""Objects before a background: known by alpha, or found; nothing is left outside of them."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from asysplat import Gaussians, load, open_photographs, refine, render
from asysplat.data import ProceduralScene
from asysplat.data.background import find_background
from asysplat.data.photographs import RANGES, with_background
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.ranges import check_options
from asysplat.refinement.hull import is_outside
from asysplat.refinement.init import initial_gaussians
from asysplat.refinement.settings import DEFAULT
from asysplat.rendering import INRIA
from asysplat.scene import Cameras, Views

SIZE = 48
WHITE, BLACK = torch.ones(3), torch.zeros(3)


def turntable(count):
    """Cameras on a circle of radius 2, which look at the origin from above and below in turn."""
    poses = torch.eye(4).repeat(count, 1, 1)
    angles = torch.arange(count) * (2 * np.pi / count)
    centers = torch.stack(
        (2 * angles.cos(), 1 - 2.0 * (torch.arange(count) % 2), 2 * angles.sin()), -1
    )
    forward = torch.nn.functional.normalize(-centers, dim=-1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).expand_as(forward), forward), dim=-1
    )
    poses[:, :3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward), -1)
    poses[:, :3, 3] = centers
    intrinsics = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]])
    return Cameras(intrinsics.repeat(count, 1, 1), poses, SIZE, SIZE)


@pytest.fixture(scope="module")
def ball():
    """Gaussians of different colors on a ball of radius 0.4."""
    generator = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=-1)
    ones = torch.ones(len(means))
    colors = torch.rand(600, 1, 3, generator=generator) * 3 - 1.5
    quats, scales = torch.eye(4)[:1].repeat(600, 1), 0.05 * ones[:, None].repeat(1, 3)
    return Gaussians(0.4 * means, quats, scales, 0.9 * ones, colors)


@pytest.fixture(scope="module")
def views(ball):
    """Its photographs on white, with exact alphas."""
    cameras = turntable(16)
    with torch.no_grad():
        drawn = render(ball, cameras, WHITE)
    return Views(cameras, drawn.image.clamp(0, 1), alphas=drawn.alpha).validate()


def test_fog_of_the_backgrounds_color_fades(ball, views):
    """A single view, which has no hull, tells it from the background in the steps before others."""
    view, fog = views.select([0]), ball.map(lambda field: field[:300])
    fog = replace(fog, means=2 * fog.means, sh=torch.full_like(fog.sh, 0.5 / 0.2820948))
    start = Gaussians(
        **{name: torch.cat((field, vars(fog)[name])) for name, field in vars(ball).items()}
    )

    def alpha(gaussians):
        alphas = render(gaussians, view.cameras).alpha
        return alphas[view.alphas == 0].mean()

    refined = refine(start, view, replace(DEFAULT, densify="none"), steps=60, background=WHITE)
    assert alpha(start) > 0.3 and alpha(refined) < 0.03


def test_nothing_is_left_outside_the_hull(views):
    inputs = views.select(range(1, 16))
    start = initial_gaussians("plane_sweep", inputs, DEFAULT.initial_limit)
    found = refine(start, inputs, DEFAULT, steps=60, background=WHITE)
    assert found.num_gaussians > 500
    assert (found.means.norm(dim=-1) < 0.6).all() and not is_outside(found.means, inputs).any()
    with torch.no_grad():
        on_black = render(found, views.cameras.select([0]), BLACK)
    wrong = (on_black.alpha - views.alphas[:1]).abs()
    assert wrong.mean() < 0.03 and on_black.alpha[views.alphas[:1] == 0].mean() < 0.01
    fog = replace(inputs, alphas=None)
    start = initial_gaussians("plane_sweep", fog, DEFAULT.initial_limit)
    fog = refine(start, fog, DEFAULT, steps=60, background=WHITE)
    assert not (fog.means.norm(dim=-1) < 0.6).all()


def test_a_hole_in_one_mask_removes_nothing(ball, views):
    assert not is_outside(ball.means, views).any()
    alphas = views.alphas.clone()
    alphas[3] = 0
    assert not is_outside(ball.means, replace(views, alphas=alphas)).any()
    around = 2 * ball.means[::10]
    assert is_outside(around, views).float().mean() > 0.9


def test_the_color_around_an_object_is_found_in_spite_of_noise_and_shading(views):
    noise = 0.01 * torch.randn(views.images.shape, generator=torch.Generator().manual_seed(0))
    shading = 1 - 0.05 * torch.linspace(0, 1, 16)[:, None, None, None]
    color, alphas = find_background((0.9 * views.images * shading + noise).clamp(0, 1))
    torch.testing.assert_close(color, torch.full((3,), 0.88), atol=0.02, rtol=0)
    assert ((alphas == 0) == (views.alphas < 0.05)).float().mean() > 0.95


def test_masked_pixels_do_not_show_the_color(views):
    masks = torch.ones_like(views.alphas, dtype=torch.bool)
    masks[:, :, :4] = False  # as beyond the border of a lens
    plain = replace(views, alphas=None, masks=masks)
    inputs, _, color = with_background(plain, plain, "auto", lambda text: None)
    assert torch.equal(color, WHITE) and (inputs.alphas[~masks] == 1).all()
    assert (inputs.alphas[masks] == 0).float().mean() > 0.5


def test_a_sweep_draws_nothing_at_pixels_of_the_background(views):
    scene = views.select(range(0, 16, 2))
    found = load("shipped")(scene)
    opaque = scene.alphas.flatten() > 0.5
    drawn = found.opacities > INRIA.alpha_min
    assert not drawn[~opaque].any()
    assert drawn[opaque].float().mean() > 0.9


def test_a_place_is_no_object():
    for seed, places in ((0, "outdoors"), (1, "rooms")):
        scene = ProceduralScene(seed, SIZE, SIZE, num_images=16, places=places)
        inputs = scene.views(range(16))
        assert find_background(inputs.images) is None
        same, _, color = with_background(inputs, inputs, "auto", pytest.fail)
        assert same.alphas is None and torch.equal(color, inputs.mean_color())
        assert torch.equal(same.images, inputs.images)


@pytest.mark.parametrize("name", ["fern", "fox", "mydesk", "hololens-000"])
def test_photographs_of_places_are_no_objects(shared, name):
    photographs = open_photographs(shared / "data" / name, height=64, say=lambda text: None)
    assert photographs.inputs.alphas is None
    assert torch.equal(photographs.background, photographs.inputs.mean_color())


def test_the_background_may_be_chosen(views):
    said = []
    for choice, expected in (("auto", WHITE), ("black", BLACK), ([0, 0.5, 0], [0, 0.5, 0])):
        inputs, targets, color = with_background(views, views, choice, said.append)
        assert color.tolist() == list(expected)
        on_color = views.images + (1 - views.alphas[:, None]) * (color - 1)[:, None, None]
        torch.testing.assert_close(inputs.images, on_color.clamp(0, 1))
        assert torch.equal(targets.images, inputs.images)
    assert "pixels are black behind it" in said[1]
    for wrong in ("pink", [1, 2], [0, 0, 3]):
        with pytest.raises(
            InputError, match=r"background=.*: give auto, mean, white, black, or red"
        ):
            with_background(views, views, wrong, said.append)


class LeftHalf:
    """Session of a network that finds an object in the left half of every photograph."""

    def __init__(self, path, providers):
        assert path.endswith("u2netp.onnx")

    def get_inputs(self):
        return [SimpleNamespace(name="image")]

    def run(self, _, inputs):
        assert inputs["image"].shape == (1, 3, 320, 320) and inputs["image"].dtype == np.float32
        assert abs(inputs["image"]).max() < 3  # as ImageNet is normalized
        found = np.full((1, 1, 320, 320), -1.0, dtype=np.float32)
        found[..., ::2] += 0.005  # nearly nothing
        found[..., :160] = 3.0
        return [found]


def test_a_network_finds_the_object_of_photographs_without_masks(tmp_path, monkeypatch):
    scene = ProceduralScene(seed=7, height=24, width=32, num_images=10).views(range(10))
    folder, said = tmp_path / "scene", []
    write_transforms(scene, folder)
    with pytest.raises(InputError, match=r"masks=fnd should be 'auto', .* or 'find'"):
        check_options({"masks": "fnd"}, RANGES)
    (tmp_path / "rembg").mkdir()
    for name in ("__init__.py", "u2netp.onnx"):
        (tmp_path / "rembg" / name).touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"masks=find needs .*: pip install 'asysplat\[masks\]'"):
        open_photographs("a scene that is not looked for", height=24, masks="find")
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(InferenceSession=LeftHalf))
    options = {"height": 24, "background": "black", "say": said.append}
    found = open_photographs(folder, masks="find", **options)
    plain = open_photographs(folder, masks="auto", **options)
    assert said[0] == "object: 50% of the pixels are black behind it (masks=, background=)"
    for views, before in ((found.inputs, plain.inputs), (found.held_out, plain.held_out)):
        assert views.alphas.shape == (len(before.images), 24, 32)
        assert (views.alphas[..., :15] == 1).all() and (views.alphas[..., 17:] == 0).all()
        torch.testing.assert_close(views.images[..., :15], before.images[..., :15])
        assert (views.images[..., 17:] == 0).all()
    for top in (255, 0):  # opaque, as some PNG are; and transparent, which needs no network
        for file in (folder / "images").iterdir():
            image = Image.open(file).convert("RGBA")
            image.paste((0, 0, 0, top), (0, 0, 32, 12))
            image.save(file)
        alphas = open_photographs(folder, masks="find", **options).inputs.alphas
        kept = alphas[:, :12, :15].mean(), alphas[:, 13:, 17:].mean()
        assert kept == ((1, 0) if top else (0, 1))
