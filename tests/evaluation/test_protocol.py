"""Named protocols against scikit-image, the lpips package and torchmetrics on the same images."""

from dataclasses import replace

import lpips
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image
from skimage.metrics import structural_similarity

from asysplat import Cameras, Gaussians, Views, render
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.protocol import Protocol

NAMES = ("default", "longlrm", "pixelsplat")


@pytest.fixture(scope="module")
def protocols(composed) -> dict[str, Protocol]:
    return {name: instantiate(composed(f"metrics={name}").metrics) for name in NAMES}


def views(images, depths=None, masks=None):
    count, _, height, width = images.shape
    intrinsics = torch.tensor([[20.0, 0, 8.0], [0, 20.0, 8.0], [0, 0, 1]]).repeat(count, 1, 1)
    cameras = Cameras(intrinsics, torch.eye(4).repeat(count, 1, 1), height, width)
    return Views(cameras, images, depths, masks)


def synthetic():
    """Smooth images, between the 8-bit values."""
    coarse = torch.rand(2, 3, 9, 12)
    return torch.nn.functional.interpolate(coarse, (54, 72), mode="bilinear")


def photographs(shared):
    paths = sorted((shared / "data" / "fox" / "images").glob("*.jpg"))[:2]
    if not paths:
        pytest.skip("shared data has no photographs of fox")
    small = [np.array(Image.open(path).convert("RGB").resize((72, 96))) for path in paths]
    return torch.from_numpy(np.stack(small)).permute(0, 3, 1, 2) / 255


def by_scikit(rendered, target, **options):
    pairs = zip(rendered.double().numpy(), target.double().numpy(), strict=True)
    return [structural_similarity(a, b, channel_axis=0, data_range=1, **options) for a, b in pairs]


def clamped(rendered):
    return rendered.clamp(0, 1)


def in_a_file(rendered):
    """Renderings as read from files with 8 bits a channel."""
    return (rendered.clamp(0, 1) * 255).to(torch.uint8).float() / 255


def check(found, expected):
    assert found.tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.medium
@pytest.mark.parametrize(
    "name, store, options",
    [
        ("default", clamped, {"gaussian_weights": True, "use_sample_covariance": False}),
        ("longlrm", clamped, {}),  # scikit-image's default
        ("pixelsplat", in_a_file, {"win_size": 11, "gaussian_weights": True}),
    ],
)
def test_protocols_have_the_psnr_of_stored_images_and_scikit_images_ssim(
    protocols, name, store, options
):
    target = synthetic()
    rendered = target + 0.4 * torch.randn_like(target)  # partly outside [0, 1]
    found = protocols[name].image_metrics(rendered, views(target), None)
    stored = store(rendered)
    check(found["ssim"], by_scikit(stored, target, **options))
    check(found["psnr"], (-10 * (stored - target).square().mean((1, 2, 3)).log10()).tolist())


@pytest.mark.parametrize("name", ["default", "pixelsplat"])
def test_lpips_is_that_of_the_lpips_package(protocols, shared, name):
    weights, protocol = shared / "weights", protocols[name]
    stored = weights / f"{dict(alex='alexnet', vgg='vgg16')[protocol.lpips_net]}_features_fp16.pth"
    if not stored.is_file():
        pytest.skip(f"{stored} is absent")
    state = torch.get_rng_state()
    ours = load_lpips(protocol.lpips_net, weights)
    assert torch.equal(torch.get_rng_state(), state) and not ours.training
    assert not any(parameter.requires_grad for parameter in ours.parameters())
    theirs = lpips.LPIPS(net=protocol.lpips_net, pnet_rand=True, verbose=False).eval()
    state = torch.load(stored, weights_only=True)
    keys = {key: "features." + key.split(".", 1)[1] for key in theirs.net.state_dict()}
    theirs.net.load_state_dict({key: state[ours_key].float() for key, ours_key in keys.items()})

    target = photographs(shared)
    rendered = target + 0.1 * torch.randn_like(target)
    shown = in_a_file(rendered) if name == "pixelsplat" else rendered.clamp(0, 1)
    with torch.no_grad():
        expected = theirs(shown, target, normalize=True).flatten().tolist()
    check(protocol.image_metrics(rendered, views(target), ours)["lpips"], expected)


@pytest.mark.parametrize("alignment", ["none", "median"])
def test_masked_pixels_are_not_in_depth_metrics(alignment):
    protocol = Protocol("mine", False, "gaussian", "biased", "alex", "images", alignment)
    images, masks = torch.rand(2, 3, 8, 8), torch.rand(2, 8, 8) < 0.6
    depths = torch.rand(2, 8, 8) + 1
    rendered = (depths * 1.1).where(masks, 0)  # as `render` leaves them
    found = protocol.depth_metrics(rendered, views(images, depths, masks))
    error = 0.1 if alignment == "none" else 0.0
    torch.testing.assert_close(found["absrel"], torch.full((2,), error), atol=1e-5, rtol=0)
    assert found["delta1"].tolist() == [1, 1]
    assert found["absrel_median"].max() < 1e-5  # with either alignment of the others

    elsewhere = depths.where(masks, 50 * torch.rand(2, 8, 8))
    assert torch.equal(
        protocol.depth_metrics(rendered, views(images, elsewhere, masks))["absrel"], found["absrel"]
    )
    unmasked = protocol.depth_metrics(rendered, views(images, depths))
    assert (unmasked["absrel"] > found["absrel"] + 0.05).all()
    assert (unmasked["delta1"] < 1).all()


def test_a_fully_masked_view_has_no_depth_metric(protocols):
    masks = torch.tensor([True, False])[:, None, None].expand(2, 8, 8)
    targets = views(torch.rand(2, 3, 8, 8), torch.ones(2, 8, 8), masks)
    found = protocols["default"].depth_metrics(torch.ones(2, 8, 8), targets)
    assert found["absrel"][0] == 0 and found["absrel"][1].isnan() and found["delta1"][1].isnan()
    assert protocols["default"].depth_metrics(torch.ones(2, 8, 8), views(targets.images)) == {}


@pytest.mark.parametrize(
    "opacities, weights, median",
    [((0.4, 0.9), (0.4, 0.54), 4.0), ((0.6, 0.9), (0.6, 0.36), 2.0), ((0.2, 0.2), (0.2, 0.16), 0)],
)
def test_the_median_depth_is_that_of_one_of_two_gaussians_or_wrong(
    protocols, opacities, weights, median
):
    gaussians = Gaussians(  # larger than the image, at depths of 2 and 4
        means=torch.tensor([[0.0, 0, 2], [0, 0, 4]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.tensor([[9.0, 9, 0.01]] * 2),
        opacities=torch.tensor(opacities),
        sh=torch.zeros(2, 1, 3),
    )
    targets = views(torch.rand(1, 3, 16, 16), torch.full((1, 16, 16), 4.0))
    depths = [
        render(gaussians, targets.cameras, backend="reference", depth=kind).depth
        for kind in ("expected", "median")
    ]
    found = protocols["default"].depth_metrics(depths[0], targets, depths[1])
    expected = (2 * weights[0] + 4 * weights[1]) / sum(weights)
    assert found["absrel"].item() == pytest.approx(1 - expected / 4, abs=0.01)
    assert found["median_depth_absrel"].item() == pytest.approx(1 - median / 4)
    assert found["median_depth_delta1"].item() == (median == 4)


def test_the_baseline_of_depths_has_the_mean_known_inverse_depth_of_the_inputs(protocols):
    protocol, images, masks = protocols["default"], torch.rand(1, 3, 16, 16), torch.ones(1, 16, 16)
    depths, true = torch.full((1, 16, 16), 1.5), torch.ones(1, 16, 16)
    depths[:, :, 4:8], depths[:, :, 8:12], depths[:, :, 12:] = 3, 0, 100  # 0: unknown
    masks[:, :, 12:], true[:, 8:] = 0, 4
    inputs, targets = views(images, depths, masks.bool()), views(images, true)
    found = protocol.measure_baselines(inputs, targets, None)
    assert list(found) == ["mean_color", "nearest_view", "mean_inverse_depth"]
    # 2 where it is 1 or 4; scaled to the (lower) median it is 1.
    expected = {"absrel": (1 + 0.5) / 2, "delta1": 0, "absrel_median": 0.75 / 2}
    assert found["mean_inverse_depth"] == [pytest.approx(expected)]
    for others in ((inputs, views(images)), (views(images), targets)):
        assert "mean_inverse_depth" not in protocol.measure_baselines(*others, None)
    fast = protocol.measure_baselines(inputs, targets, None, psnr_only=True)
    assert "mean_inverse_depth" not in fast
    unknown = replace(inputs, depths=torch.zeros_like(depths))
    (row,) = protocol.measure_baselines(unknown, targets, None)["mean_inverse_depth"]
    assert (row["absrel"], row["delta1"]) == (1, 0)


@pytest.mark.parametrize("name", NAMES)
def test_masked_pixels_are_not_in_image_metrics(protocols, name):
    target, masks = synthetic(), torch.rand(2, 54, 72) < 0.5
    rendered = target + 0.1 * torch.randn_like(target)
    found, worse = (
        protocols[name].image_metrics(image, views(target, masks=masks), None)
        for image in (rendered, rendered.where(masks[:, None], 0))
    )
    assert torch.equal(found["psnr"], worse["psnr"])
    assert torch.equal(found["psnr"], protocols[name].psnr(rendered, views(target, masks=masks)))
    assert (found["psnr"] > protocols[name].psnr(rendered, views(target)) + 1).all()


def test_rows_of_views_are_the_metrics_of_all_at_once(protocols):
    protocol, images = protocols["default"], synthetic()
    targets = views(images, torch.ones(2, 54, 72), torch.rand(2, 54, 72) < 0.9)
    rendered, depths = images + 0.1 * torch.randn_like(images), torch.full((2, 54, 72), 1.1)
    values = protocol.image_metrics(rendered, targets, None)
    values |= protocol.depth_metrics(depths, targets)
    rows = protocol.measure_views(rendered, depths, targets, None)
    assert rows == [{name: value[v].item() for name, value in values.items()} for v in (0, 1)]
    psnrs = protocol.measure_views(rendered, None, targets, None, psnr_only=True)
    assert psnrs == [{"psnr": row["psnr"]} for row in rows]
    baselines = protocol.measure_baselines(targets, targets, None)
    assert baselines["nearest_view"][0] == {"psnr": pytest.approx(100), "ssim": pytest.approx(1)}
    assert baselines["mean_color"][0]["psnr"] < 30


def test_eight_bits_of_pixelsplat_do_not_change_photographs(protocols):
    every = (torch.arange(256.0) / 255).expand(1, 3, 16, 256)
    assert protocols["pixelsplat"].psnr(every, views(every)).item() == pytest.approx(100)


def test_every_option_of_a_protocol_changes_a_description(protocols):
    plain = protocols["default"]
    changes = [
        *({"eight_bit": True}, {"ssim_window": "uniform"}, {"ssim_covariance": "sample"}),
        *({"lpips_net": "vgg"}, {"mean_over": "scenes"}, {"depth_alignment": "median"}),
        {"psnr_over": "masks"},
    ]
    assert {key for change in changes for key in change} == set(vars(plain)) - {"name"}
    texts = [replace(plain, **change).describe() for change in [{}, *changes]]
    assert len({tuple(text.values()) for text in texts}) == len(texts)
