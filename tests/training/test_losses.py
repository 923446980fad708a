"""Each term of the loss against its formula; terms without data are off."""

import math
import warnings
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from tiny import NETWORK
from torchvision.models import vgg16 as torchvision_vgg16
from torchvision.models import vgg19 as torchvision_vgg19

from asysplat.errors import InputError
from asysplat.evaluation.metrics import ssim
from asysplat.rendering import Rendering
from asysplat.runs.runs import config_hash
from asysplat.scene import Cameras, Gaussians, Views
from asysplat.training import InputDisparity, LogDepth, Prediction, RenderedDisparity, SplattingLoss
from asysplat.training.losses.disparity import (
    disparity_distance,
    own_depths,
    reference_disparities,
)
from asysplat.training.losses.perceptual import longlrm, vgg16
from asysplat.training.prepare import drop_missing_perceptual_term

MEAN = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
STD = torch.tensor([0.229, 0.224, 0.225])[:, None, None]


def cameras(size, views=2):
    pose = torch.eye(4).expand(views, 4, 4)
    intrinsics = torch.tensor([[30.0, 0, size / 2], [0, 30.0, size / 2], [0, 0, 1]])
    return Cameras(intrinsics.expand(views, 3, 3), pose, size, size)


def gaussians_at(means):
    ones = torch.ones(*means.shape[:-1], 4)
    return Gaussians(means, ones, ones[..., :3], ones[..., 0] / 2, 0 * ones[..., None, :3])


def one_view(depth=None):
    return Rendering(torch.rand(1, 3, 4, 4), torch.ones(1, 4, 4), depth, {})


def make_loss(mse=0.0, perceptual=0.0, depth=0.0, **options):
    return SplattingLoss(mse=mse, perceptual=perceptual, depth=depth, **options)


def pair(size=32, depths=True):
    depth = 1 + torch.rand(2, size, size)
    images = torch.rand(2, 3, size, size)
    targets = Views(cameras(size), images, depth if depths else None)
    rendering = Rendering(
        image=torch.rand(2, 3, size, size).requires_grad_(),
        alpha=torch.ones(2, size, size),
        depth=(1 + torch.rand(2, size, size)).requires_grad_(),
        stats={},
    )
    prediction = Prediction(gaussians_at(torch.ones(2 * size * size, 3)), rendering)
    return prediction, {"inputs": targets, "targets": targets}


def test_nearly_constant_depths_have_no_greater_gradients_than_others():
    """Those of an untrained network."""
    target = 0.5 + torch.rand(2, 16, 16)
    norms = []
    for spread in (1e-3, 0.5):
        depth = (2 + spread * torch.rand(2, 16, 16)).requires_grad_()
        disparity_distance(depth, target, torch.ones_like(target, dtype=torch.bool)).backward()
        norms.append(depth.grad.norm())
    assert norms[0] < 2 * norms[1]


def test_disparities_come_before_depths():
    views = pair()[1]["targets"]
    views.depths[0, 0, 0] = 0
    known = reference_disparities(views)
    assert known[0, 0, 0] == 0
    torch.testing.assert_close(known[1], 1 / views.depths[1])
    estimated = replace(views, disparities=torch.rand(2, 32, 32))
    assert torch.equal(reference_disparities(estimated), estimated.disparities)
    assert reference_disparities(replace(views, depths=None)) is None


def test_mean_squared_error_and_opacity_which_is_off_by_default():
    prediction, batch = pair()
    gaussians = replace(prediction.gaussians, opacities=torch.rand(2048).requires_grad_())
    prediction = Prediction(gaussians, prediction.rendering)
    terms = make_loss(mse=2.0, opacity=0.1)(prediction, batch)
    expected = (prediction.rendering.image - batch["targets"].images).square().mean()
    torch.testing.assert_close(terms["mse"], expected)
    torch.testing.assert_close(terms["opacity"], gaussians.opacities.mean())
    torch.testing.assert_close(terms["loss"], 2 * terms["mse"] + 0.1 * terms["opacity"])
    assert set(make_loss(mse=1.0)(prediction, batch)) == {"loss", "mse"}


# Disparities (1, 2, 4) against (1, 2, 3), normalized: (-1, 0, 2) against (-1.5, 0, 1.5), whose
# SmoothL1 are 0.5^2 / 2, 0 and 0.5^2 / 2; the fourth pixel's depth is unknown.
DEPTHS, TARGET = [[1, 1 / 2], [1 / 4, 7]], [[1, 1 / 2], [1 / 3, 0]]
BY_HAND = 2 * 0.5**2 / 2 / 3


def test_rendered_disparity_by_hand():
    """With a Gaussian for 2 x 2 pixels, those at every second place count, and those alone."""
    depth = torch.full((1, 4, 4), 5.0)
    target = torch.full((1, 4, 4), 9.0)
    depth[:, ::2, ::2], target[:, ::2, ::2] = torch.tensor(DEPTHS), torch.tensor(TARGET)
    depth.requires_grad_()
    views = Views(cameras(4, views=1), torch.rand(1, 3, 4, 4), target)
    prediction = Prediction(gaussians_at(torch.ones(4, 3)), one_view(depth))
    loss = make_loss(depth=1.0)
    assert loss.needs_depth
    terms = loss(prediction, {"inputs": views, "targets": views})
    torch.testing.assert_close(terms["depth"].item(), BY_HAND)
    terms["loss"].backward()
    assert depth.grad[:, ::2, ::2].abs().sum() > 0 and (depth.grad[:, 1::2] == 0).all()


@pytest.mark.parametrize(("size", "stride"), [(4, 1), (16, 4)])
def test_the_stride_is_that_of_the_gaussians(size, stride):
    """p_c / p_f: 16 Gaussians of one view. Another can be given."""
    views = Views(cameras(size, views=1), torch.rand(1, 3, size, size), torch.ones(1, size, size))
    rendering = Rendering(views.images, torch.ones(1, size, size), torch.rand(1, size, size), {})
    prediction = Prediction(gaussians_at(torch.ones(16, 3)), rendering)
    for term, step in ((RenderedDisparity(), stride), (RenderedDisparity(stride=2), 2)):
        kept = [maps[:, ::step, ::step] for maps in (rendering.depth, views.depths)]
        expected = disparity_distance(*kept, torch.ones_like(kept[0], dtype=torch.bool))
        torch.testing.assert_close(term(prediction, {"inputs": views, "targets": views}), expected)


def test_input_disparity_by_hand():
    """Gaussians of turned and moved views, each against its own view; and the gradient."""
    camera = cameras(4)
    pose = camera.cam_to_world.clone()
    spin = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.3, -0.9], [-0.3, 0, 0.2], [0.9, -0.2, 0]]))
    pose[1, :3, :3], pose[1, :3, 3] = spin, torch.tensor([1.0, -2.0, 0.5])
    camera = Cameras(camera.intrinsics, pose, 4, 4)
    depth = torch.tensor([DEPTHS, [[2.0, 1.0], [0.5, 3.0]]])
    target = torch.full((2, 4, 4), 9.0)
    # The second view's are a scaled copy: nothing to add.
    target[:, ::2, ::2] = torch.stack((torch.tensor(TARGET), 3 * depth[1]))
    inputs = Views(camera, torch.rand(2, 3, 4, 4), target)
    local = torch.stack((torch.randn_like(depth), torch.randn_like(depth), depth), -1)
    rotation, center = pose[:, None, None, :3, :3], pose[:, None, None, :3, 3]
    means = ((rotation @ local[..., None])[..., 0] + center).flatten(0, 2).requires_grad_()
    gaussians = gaussians_at(means)
    torch.testing.assert_close(own_depths(gaussians, inputs), depth)

    loss = make_loss(depth=1.0, depth_term=InputDisparity)
    assert not loss.needs_depth
    targets = Views(cameras(4, views=1), torch.rand(1, 3, 4, 4))
    terms = loss(Prediction(gaussians, one_view()), {"inputs": inputs, "targets": targets})
    # Three pixels of the first view and four of the second.
    torch.testing.assert_close(terms["depth"].item(), BY_HAND * 3 / 7)
    terms["loss"].backward()
    # Along the first view's axis; not where the depth is unknown, nor where nothing is wrong.
    grad = means.grad.view(2, 2, 2, 3)
    assert grad.isfinite().all() and grad[0, 1, 0, 2] != 0 and (grad[0, ..., :2] == 0).all()
    assert (grad[0, 1, 1] == 0).all() and grad[1].abs().max() < 1e-6


def test_input_disparity_of_a_network(build):
    """Its Gaussians are the map that the term takes them to be, in a batch, at half the size."""
    net = build("model=asysplat_4m4s", *NETWORK)
    two = cameras(32)
    inputs = Views(two, torch.rand(2, 3, 32, 32), 1 + torch.rand(2, 32, 32))
    inputs = Views.stack([inputs, inputs])
    gaussians = net(inputs)
    depths = own_depths(gaussians, inputs)
    assert depths.shape == (2, 2, 16, 16)
    torch.testing.assert_close(depths.flatten(1), gaussians.means[..., 2])
    term = InputDisparity()(Prediction(gaussians, pair()[0].rendering), {"inputs": inputs})
    term.backward()
    assert term > 0 and net.head.decode.weight.grad.abs().sum() > 0


def test_gaussians_that_are_no_map_of_the_views():
    inputs = Views(cameras(4), torch.rand(2, 3, 4, 4), torch.ones(2, 4, 4))
    prediction = Prediction(gaussians_at(torch.ones(9, 3)), pair()[0].rendering)
    with pytest.raises(InputError, match=r"gave 9 for 2 views of 4x4.*training/depth=rendered"):
        InputDisparity()(prediction, {"inputs": inputs})


def test_log_depth_sees_the_scale_and_ignores_unknown_depths():
    depth = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
    known = torch.tensor([[[1.0, 4.0], [0.0, 1.0]]])
    inputs = Views(cameras(2, views=1), torch.rand(1, 3, 2, 2), known)
    means = torch.stack((torch.zeros_like(depth), torch.zeros_like(depth), depth), -1)
    scale = torch.ones((), requires_grad=True)
    gaussians = gaussians_at(scale * means.flatten(0, 2))
    prediction, term = Prediction(gaussians, one_view()), LogDepth()
    distance = term(prediction, {"inputs": inputs})
    torch.testing.assert_close(distance.item(), (math.log(2) + math.log(4)) / 3)
    # Of three known depths one is right, one too small and one too large.
    distance.backward()
    assert scale.grad.abs() <= 1 / 3 + 1e-6
    no_depths = Views(inputs.cameras, inputs.images)
    assert term(prediction, {"inputs": no_depths}) is None
    masked = replace(inputs, masks=torch.tensor([[[True, False], [True, False]]]))
    assert term(prediction, {"inputs": masked}) == 0


@pytest.mark.parametrize("rows", [8, 32])
def test_pixels_without_depth_do_not_count(rows):
    """Of some rows, and of all, where the term is 0."""
    prediction, batch = pair()
    batch["targets"].depths[:, :rows] = 0
    terms = make_loss(depth=1.0)(prediction, batch)
    terms["loss"].backward()
    grad = prediction.rendering.depth.grad
    assert (grad[:, :rows] == 0).all() and grad.isfinite().all()
    assert (terms["loss"] == 0) == (grad.abs().sum() == 0) == (rows == 32)


@pytest.mark.parametrize(
    ("term", "reason"),
    [
        (RenderedDisparity, "neither disparities nor depths; asysplat p"),
        (InputDisparity, "neither disparities nor depths; asysplat p"),
        (LogDepth, "no depths; training/depth=rendered takes disparities"),
    ],
)
def test_data_without_depth_turns_the_term_off_with_one_warning(term, reason):
    prediction, batch = pair(depths=False)
    loss = make_loss(mse=1.0, depth=1.0, depth_term=term)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            assert "depth" not in loss(prediction, batch)
    assert [reason in str(warning.message) for warning in caught] == [True]


@pytest.mark.medium
@pytest.mark.parametrize(("term", "name"), [("vgg16", "vgg16"), ("longlrm", "matconvnet_vgg19")])
def test_a_missing_network_turns_the_term_off_or_is_refused(
    composed, tmp_path, monkeypatch, term, name
):
    """The configuration says so, and so does its hash: that of a run without the term."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    command = [f"paths.weights={tmp_path}", f"training/perceptual={term}", "paths.run=here"]
    config = composed(*command, "training.loss.perceptual=0.5")
    with pytest.warns(UserWarning, match=f"weights of {name} are neither .* paths.weights"):
        drop_missing_perceptual_term(config)
    assert config_hash(config) == config_hash(composed(*command, "training.loss.perceptual=0.0"))
    config = composed(*command, "training.loss.perceptual=0.5", "allow_missing_losses=false")
    message = r"perceptual=0.5: .* paths.download=true .* allow_missing_losses=true"
    with pytest.raises(InputError, match=message):
        drop_missing_perceptual_term(config)


def test_a_loss_without_any_term_is_refused():
    with pytest.raises(InputError, match=r"training\.loss has no term that is on"):
        make_loss(mse=0.0, ssim=0.0, perceptual=0.0, depth=0.0)


def test_the_ssim_term_is_what_ssim_lacks_of_1():
    prediction, batch = pair()
    terms = make_loss(mse=0.5, ssim=2.0)(prediction, batch)
    image, targets = prediction.rendering.image, batch["targets"].images
    assert terms["ssim"] == 1 - ssim(image, targets).mean() and terms["ssim"] > 0.5
    assert terms["loss"] == 0.5 * F.mse_loss(image, targets) + 2 * terms["ssim"]


def test_data_without_depth_is_refused_where_it_is_not_allowed():
    loss = make_loss(mse=1.0, depth=0.01, allow_missing=False)
    with pytest.raises(
        InputError, match=r"depth=0.01: .* asysplat prepare --disparities estimates"
    ):
        loss(*pair(depths=False))
    # A scene without depths after one that has them does not end a training.
    loss = make_loss(mse=1.0, depth=0.01, allow_missing=False)
    assert "depth" in loss(*pair()) and "depth" not in loss(*pair(depths=False))


NETWORKS = {
    "vgg16": (vgg16, torchvision_vgg16, "vgg16-0a1b2c3d.pth"),
    "longlrm": (longlrm, torchvision_vgg19, "matconvnet_vgg19.pt"),
}


@pytest.fixture(scope="module")
def distances(tmp_path_factory):
    """By name: a perceptual distance of random weights, and torchvision's convolutions of them."""
    folder, made = tmp_path_factory.mktemp("hub"), {}
    (folder / "checkpoints").mkdir()
    torch.manual_seed(0)
    for name, (distance, network, file) in NETWORKS.items():
        with torch.device("meta"):
            features = network().features
        features.to_empty(device="cpu")
        for layer in features:
            if isinstance(layer, torch.nn.Conv2d):
                torch.nn.init.kaiming_normal_(layer.weight)
                torch.nn.init.normal_(layer.bias, std=0.1)
        features = features.half().float()  # as both files give them
        file = folder / "checkpoints" / file
        torch.save(features.state_dict(prefix="features."), file)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch.hub, "get_dir", lambda: str(folder))
            made[name] = distance(), features
        file.unlink()
    return made


LAYERS = {  # the scale of images, and the weights by the end of their layers; 0: the images'
    "vgg16": (1 / STD, dict.fromkeys((4, 9, 16, 23, 30), 1 / 5)),
    "longlrm": (255, {0: 1, 4: 0.3846, 9: 0.2083, 14: 0.2703, 23: 0.1786, 32: 6.6667}),
}


@pytest.mark.medium
@pytest.mark.parametrize("name", LAYERS)
def test_layers_and_weights(distances, name):
    """Long-LRM's have mean pooling."""
    (distance, features), (scale, weights) = distances[name], LAYERS[name]
    rendered, target = torch.rand(2, 2, 3, 32, 32), torch.rand(2, 2, 3, 32, 32)
    a, b = (scale * (x.flatten(0, 1) - MEAN) for x in (rendered, target))
    expected, start = 0.0, 0
    for end, weight in weights.items():
        for layer in features[start:end]:
            pools = name == "longlrm" and isinstance(layer, torch.nn.MaxPool2d)
            a, b = (F.avg_pool2d(x, 2) if pools else layer(x) for x in (a, b))
        expected, start = expected + weight * (a - b).abs().mean(), end
        assert not end or name == "longlrm" or isinstance(layer, torch.nn.ReLU)
    expected = expected / 255 if name == "longlrm" else expected
    torch.testing.assert_close(distance(rendered, target), expected)


@pytest.mark.medium
@pytest.mark.parametrize("name", NETWORKS)
def test_perceptual_term_has_the_same_bits_under_autocast(distances, name):
    distance, _ = distances[name]
    target = torch.rand(1, 2, 3, 32, 32)

    def value_and_gradient(enabled):
        rendered = target.flip(-1).requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            value = distance(rendered, target)
        return value.detach(), *torch.autograd.grad(value, rendered)

    plain, cast = value_and_gradient(False), value_and_gradient(True)
    assert cast[0].dtype == torch.float32 and all(map(torch.equal, plain, cast))
    assert plain[0] > 0 and plain[1].abs().sum() > 0


@pytest.mark.parametrize("name", NETWORKS)
def test_the_perceptual_term_is_0_for_equal_images_and_trains_only_the_prediction(distances, name):
    distance, _ = distances[name]
    loss = make_loss(perceptual=1.0, perceptual_term=lambda: distance)
    prediction, batch = pair()
    terms = loss(prediction, batch)
    terms["loss"].backward()
    assert terms["perceptual"] > 0 and prediction.rendering.image.grad.abs().sum() > 0
    assert not any(p.requires_grad for p in distance.parameters())
    same = Rendering(batch["targets"].images, prediction.rendering.alpha, None, {})
    assert loss(Prediction(prediction.gaussians, same), batch)["perceptual"] == 0
    assert not loss.state_dict() and not list(loss.parameters())
