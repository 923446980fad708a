"""The whole network: the paper's parameter counts, its inputs and components."""

import re

import pytest
import torch
from hydra.errors import InstantiationException
from tiny import NETWORK as TINY

from asysplat.errors import InputError, input_error_behind
from asysplat.models import LongLRMHead
from asysplat.models.stage import parse_layer_mix
from asysplat.scene import Cameras, Views


def make_views(batch=(2,), views=3, height=32, width=64):
    intrinsics = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    pose = torch.eye(4).expand(*batch, views, 4, 4).clone()
    pose[..., :3, 3] = 0.3 * torch.randn(*batch, views, 3)
    cameras = Cameras(intrinsics.expand(*batch, views, 3, 3), pose, height, width)
    return Views(cameras, torch.rand(*batch, views, 3, height, width))


# Every model of architecture.md and its parameters as built here, in units of 1e6.
PARAMETERS = {
    "asysplat_4m4s": 98.11,
    "asysplat_7m1s": 86.84,
    "asysplat_7m1t": 85.91,
    "asysplat_4m4t": 94.40,
    "asysplat_8t": 105.72,
    "asysplat_4m4s_noconv": 94.40,
    "asysplat_pred_fine": 98.11,
    "asysplat_pred_coarse": 96.05,
    "asysplat_only_fine_to_coarse": 92.96,
    "asysplat_only_coarse_to_fine": 90.96,
    "asysplat_no_mambavision": 94.10,
    "asysplat_8m0a": 93.58,
    "asysplat_7m1a": 96.59,
    "asysplat_6m2a": 99.61,
    "asysplat_2m6a": 100.06,
    "single_branch": 94.29,
    "two_branch": 90.26,
    "gs_lrm": 306.50,
    "longlrm": 141.92,
    "longlrm_18": 103.00,
    "longlrm_24": 98.89,
    "longlrm_24h": 101.85,
}


QUICK = ("asysplat_4m4s", "asysplat_7m1t", "single_branch", "longlrm", "gs_lrm")
MODELS = [pytest.param(m, marks=[] if m in QUICK else [pytest.mark.medium]) for m in PARAMETERS]


@pytest.mark.parametrize("model", MODELS)
def test_parameters_and_head_at_full_width(build, model):
    net = build("scale=paper", f"model={model}", device="meta")
    millions = sum(p.numel() for p in net.parameters()) / 1e6
    assert round(millions, 2) == PARAMETERS[model]
    assert type(net.head) is LongLRMHead  # one for all; at laptop scale tests/conf trains ours


@pytest.mark.medium
@pytest.mark.parametrize(("width", "ratio"), [(0.125, 0.95), (0.25, 0.7), (1.0, 0.3)])
def test_a_geometry_ratio_is_met_at_the_same_total(build, ratio, width):
    model = ("model=asysplat_4m4s", f"width={width}")
    base = build(*model, device="meta")
    net = build(*model, f"geometry_ratio={ratio}", device="meta")
    total, expected = (sum(p.numel() for p in n.parameters()) for n in (net, base))
    assert abs(net.geometry_ratio() - ratio) <= 0.015
    assert abs(total / expected - 1) < 0.01
    assert all(width % net.widths.head_dim == 0 for width in (*net.widths.stages, net.widths.fine))
    stages = "/".join(map(str, net.widths.stages))
    assert f"stages {stages} wide" in net.describe() and f"{net.widths.fine} wide" in net.describe()


@pytest.mark.medium
def test_a_parameter_budget_scales_the_total(build):
    base = build(device="meta")
    net = build("geometry_ratio=0.8", "parameter_budget=0.5", device="meta")
    total, expected = (sum(p.numel() for p in n.parameters()) for n in (net, base))
    assert abs(total / expected - 0.5) < 0.005


@pytest.mark.parametrize(
    ("overrides", "alike"),
    [
        ("model.layers=1m1t", r"geometry.*layers\.0|geometry\.(?!stages)|appearance|source|head"),
        ("model/links=none", r"geometry|appearance|source|head"),
        ("model/appearance=none", r"geometry|appearance\.tokenizer|source|head"),
        ("model/fusion=fine", r"geometry|appearance"),
        ("model.head.sh_degree=0", r"geometry|appearance|source"),
    ],
)
def test_networks_that_differ_in_a_component_start_alike_in_the_others(build, overrides, alike):
    states = []
    for options in ((), (overrides,)):
        torch.manual_seed(0)
        states.append(build(*TINY, *options).state_dict())
    base, other = states
    shared = [name for name in base.keys() & other.keys() if re.match(alike, name)]
    assert len(shared) > len(base) / 4
    assert all(torch.equal(base[name], other[name]) for name in shared)


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (["parameter_budget=0.5"], "without a geometry_ratio"),
        (["model=longlrm", "geometry_ratio=0.5"], "leave them out"),
        (["model=single_branch", "model.global_tokens=2"], "model.global_tokens=2 with sparse"),
    ],
)
def test_arguments_that_a_model_refuses(build, overrides, complaint):
    with pytest.raises(InstantiationException) as caught:
        build(*overrides, device="meta")
    assert complaint in str(input_error_behind(caught.value))


@pytest.mark.medium
@pytest.mark.parametrize(
    ("ratio", "complaint"), [(1.2, "between 0 and 1"), (0.01, "closest come stages ")]
)
def test_geometry_ratio_that_cannot_be_met(build, ratio, complaint):
    with pytest.raises(InstantiationException) as caught:
        build(f"geometry_ratio={ratio}", device="meta")
    assert complaint in str(input_error_behind(caught.value))


def test_one_gaussian_per_output_pixel_at_its_ray(build):
    views = make_views()
    net = build("model=asysplat_4m4s", *TINY)
    gaussians = net(views).validate()
    assert gaussians.means.shape == (2, 3 * 16 * 32, 3)
    camera = views.cameras.resized(16, 32)
    means = gaussians.means.view(2, 3, 16, 32, 3)
    local = torch.einsum(
        "bvij,bvhwi->bvhwj",
        views.cameras.cam_to_world[..., :3, :3],
        means - camera.centers[..., None, None, :],
    )
    pixels = torch.einsum("bvij,bvhwj->bvhwi", camera.intrinsics, local / local[..., 2:])
    y, x = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    torch.testing.assert_close(pixels[..., 0], x.expand(2, 3, 16, 32), atol=1e-3, rtol=0)
    torch.testing.assert_close(pixels[..., 1], y.expand(2, 3, 16, 32), atol=1e-3, rtol=0)


def test_untrained_colors_are_those_of_the_images(build):
    views = make_views()
    dc = build("model/head=residual", *TINY)(views).sh[..., 0, :] * 0.28209479 + 0.5
    images = torch.nn.functional.avg_pool2d(views.images.flatten(0, 1), 2)
    expected = images.permute(0, 2, 3, 1).reshape(2, -1, 3)
    assert (dc - expected).abs().mean() < 0.02


@pytest.mark.parametrize("batch", [(), (1,), (2, 2)])
def test_leading_batch_dimensions(build, batch):
    net = build(*TINY).eval()
    views = make_views(batch=batch)
    gaussians = net(views)
    assert gaussians.opacities.shape[:-1] == batch
    first = views.map(lambda tensor: tensor[(0,) * len(batch)])
    expected = net(first).means
    torch.testing.assert_close(gaussians.means[(0,) * len(batch)], expected)


def test_a_network_without_links_trains(build):
    """tests/conf trains the other components."""
    net = build(*TINY, "model/links=none")
    gaussians = net(make_views())
    (gaussians.means.mean() + gaussians.sh.square().mean()).backward()
    grads = [p.grad for p in net.head.parameters()]
    assert all(g.isfinite().all() and g.abs().sum() > 0 for g in grads)


def test_views_exchange_only_through_the_geometry_branch(build):
    """Without the coarse tokens, the prediction of a view is independent of the others."""
    views = make_views(batch=())
    changed = views.images.clone()
    changed[1] = torch.rand_like(changed[1])
    other = Views(views.cameras, changed)

    def change(*overrides):
        torch.manual_seed(0)
        net = build("model=asysplat_4m4s", *TINY, *overrides).eval()
        first_view = 16 * 32
        return (net(views).opacities - net(other).opacities)[:first_view].abs().max()

    assert change() > 0
    assert change("model/fusion=fine", "model/links=only_fine_to_coarse") == 0


def test_both_links_of_a_stage_read_the_tokens_before_the_exchange(build):
    """Eq. 3."""
    net, read = build("model=asysplat_4m4s", *TINY), []
    for link in (net.geometry.links[0], net.appearance.links[0]):
        link.register_forward_pre_hook(lambda _, tokens: read.append(tokens))
    net(make_views())
    (coarse, fine), (fine_too, coarse_too) = read
    assert coarse_too is coarse and fine_too is fine


def test_bfloat16_autocast_keeps_gaussians_in_fp32(build):
    views = make_views()
    net = build(*TINY).eval()
    with torch.autocast("cpu", torch.bfloat16):
        gaussians = net(views)
    assert gaussians.means.dtype == torch.float32
    torch.testing.assert_close(gaussians.means, net(views).means, atol=0.1, rtol=0.05)


def test_image_size_that_is_no_multiple_of_the_patch(build):
    with pytest.raises(InputError, match="set 48x48"):
        build(*TINY)(make_views(height=48, width=40))


@pytest.mark.parametrize("model", ["asysplat_4m4s", "asysplat_7m1s"])
def test_token_maps_of_any_size(build, model):
    gaussians = build(*TINY, f"model={model}")(make_views(height=48, width=80))
    assert all(field.isfinite().all() for field in (gaussians.means, gaussians.sh))


@pytest.mark.parametrize(
    ("mix", "layers"), [("4m4s", "mmmmssss"), ("7m+1t", "mmmmmmmt"), ("1s2m", "smm")]
)
def test_a_layer_mix_names_each_layer_by_its_letter(mix, layers):
    assert "".join(parse_layer_mix(mix, {"m", "s", "t"})) == layers


@pytest.mark.parametrize("mix", ["", "4x4s"])
def test_bad_layer_mix(mix):
    with pytest.raises(InputError, match="such as 4m4s"):
        parse_layer_mix(mix, {"m", "s", "t"})


@pytest.mark.gpu
def test_gpu_agrees_with_cpu(build):
    views = make_views()
    net = build(*TINY).eval()
    expected = net(views)
    on_gpu = net.cuda()(views.to("cuda")).to("cpu")
    torch.testing.assert_close(on_gpu.means, expected.means, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(on_gpu.sh, expected.sh, atol=1e-3, rtol=1e-3)
