"""Scaffold-GS: decoding, growth and pruning beside plain loops; scenes that become better."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch

from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.refinement.densification.clone_split import screen_gradients
from asysplat.refinement.scaffold_gs import (
    GRADIENT,
    MIN_OPACITY,
    OFFSETS,
    SCAFFOLD_GS,
    AnchorScene,
    AnchorStatistics,
    ScaffoldRefinement,
    refine_scaffold,
)
from asysplat.rendering import render
from asysplat.scene import Cameras


def random_scene(count: int = 40, voxel: float = 0.25, seed: int = 0) -> AnchorScene:
    """Return a scene in float64 before the camera, whose parameters are all random."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    scene = AnchorScene(points + torch.tensor([0.0, 0, 4]), voxel, seed)
    for tensor in scene.optimizer.parameters.values():
        tensor += 0.3 * torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
    return scene


@pytest.fixture
def camera():
    intrinsics = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    return Cameras(intrinsics[None], pose[None], height=24, width=32)


def layer(rows, bias, inputs):
    pairs = zip(rows, bias, strict=True)
    return [math.fsum(w * x for w, x in zip(row, inputs, strict=True)) + b for row, b in pairs]


def run_network(network, inputs):
    """Evaluate a network on numbers."""
    first, _, last = network
    hidden = layer(first.weight.tolist(), first.bias.tolist(), inputs)
    hidden = [max(0.0, value) for value in hidden]
    return layer(last.weight.tolist(), last.bias.tolist(), hidden)


def sigmoid(value):
    return 1 / (1 + math.exp(-value))


def test_decoding_equals_the_formulas_one_by_one(camera):
    scene = random_scene()
    decoded = scene.decode(camera)
    gaussians = decoded.gaussians
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    colors = gaussians.sh[:, 0] * SH_C0 + 0.5
    found = zip(*(field.tolist() for field in (*fields, colors)), strict=True)
    parameters = {name: tensor.tolist() for name, tensor in scene.optimizer.parameters.items()}
    hidden = 0
    for anchor in decoded.anchors.tolist():
        position = scene.anchors[anchor].tolist()
        distance = math.hypot(*position)  # from the camera at 0
        inputs = parameters["features"][anchor] + [x / distance for x in position]
        out = {name: run_network(net, inputs) for name, net in scene.networks.items()}
        scales = [math.exp(x) for x in parameters["log_scales"][anchor]]
        for slot in range(OFFSETS):
            opacity = math.tanh(out["opacity"][slot])
            if opacity <= 0:
                hidden += 1
                continue
            mean, quat, scale, found_opacity, color = next(found)
            shape = out["covariance"][7 * slot : 7 * slot + 7]
            offset = parameters["offsets"][anchor][slot]
            norm = math.hypot(*shape[3:])
            expected = [x + o * s for x, o, s in zip(position, offset, scales[:3], strict=True)]
            assert mean == pytest.approx(expected, abs=1e-12)
            assert quat == pytest.approx([x / norm for x in shape[3:]], abs=1e-12)
            sizes = [s * sigmoid(x) for s, x in zip(scales[3:], shape[:3], strict=True)]
            assert scale == pytest.approx(sizes, abs=1e-12)
            assert found_opacity == pytest.approx(opacity, abs=1e-12)
            rgb = out["color"][3 * slot : 3 * slot + 3]
            assert color == pytest.approx([sigmoid(x) for x in rgb], abs=1e-12)
    assert next(found, None) is None
    assert 0 < hidden < OFFSETS * len(decoded.anchors)


def test_anchors_that_reach_no_pixel_are_left_out(camera):
    scene = random_scene()
    behind, beside = torch.tensor([0.0, 0, -4]), torch.tensor([30.0, 0, 4])
    scene.anchors[:2] = torch.stack((behind, beside)).double()
    anchors = scene.decode(camera).anchors.tolist()
    assert set(anchors) == set(range(2, len(scene.anchors)))
    whole = scene.render(camera, torch.zeros(3).double())
    with pytest.MonkeyPatch.context() as patch:
        all_seen = torch.ones(len(scene.anchors), dtype=torch.bool)
        patch.setattr(AnchorScene, "_seen", lambda *_: all_seen)
        image = scene.render(camera, torch.zeros(3).double()).image
    # A matrix product of more rows may be summed in another order.
    torch.testing.assert_close(image, whole.image, rtol=0, atol=1e-12)


def test_views_are_drawn_each_by_its_own_gaussians(camera):
    scene, background = random_scene(), torch.rand(3, dtype=torch.float64)
    poses = camera.cam_to_world.repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.5, 0, 0.5])
    cameras = replace(camera, intrinsics=camera.intrinsics.repeat(3, 1, 1), cam_to_world=poses)
    masks = torch.rand(3, 24, 32) < 0.8
    drawn = scene.render(cameras, background, masks=masks)
    for view in range(3):
        one = cameras.select([view])
        alone = render(scene.decode(one).gaussians, one, background, masks=masks[[view]])
        for name in ("image", "alpha", "depth"):
            assert torch.equal(getattr(drawn, name)[view], getattr(alone, name)[0]), name
    assert scene.render(cameras, background, depth=False).depth is None
    first, last = (scene.decode(cameras.select([view])).gaussians.sh for view in (0, 2))
    assert first.shape != last.shape or not torch.equal(first, last)


@pytest.mark.parametrize("seed", range(2))
def test_growth_equals_plain_loops(seed):
    scene, voxel = random_scene(seed=seed), 0.5
    wanted = torch.rand(len(scene.anchors), OFFSETS, generator=torch.manual_seed(seed)) < 0.2
    parameters = {name: tensor.clone() for name, tensor in scene.optimizer.parameters.items()}
    before, taken, added = scene.anchors.tolist(), set(), {}
    for anchor in before:
        taken.add(tuple(round(x / voxel) for x in anchor))
    for anchor, slot in product(range(len(before)), range(OFFSETS)):
        if wanted[anchor, slot]:
            reach = parameters["log_scales"][anchor, :3].exp()
            point = scene.anchors[anchor] + parameters["offsets"][anchor, slot] * reach
            cell = tuple(round(x / voxel) for x in point.tolist())
            if cell not in taken:
                added.setdefault(cell, []).append(parameters["features"][anchor])
    scene.grow(wanted, voxel)
    assert len(added) > 5
    assert scene.anchors[: len(before)].tolist() == before
    new = scene.optimizer.parameters
    for row in range(len(before), len(scene.anchors)):
        cell = tuple(round(x / voxel) for x in scene.anchors[row].tolist())
        greatest = torch.stack(added.pop(cell)).amax(0)
        assert torch.equal(new["features"][row], greatest)
        assert new["offsets"][row].eq(0).all()
        assert new["log_scales"][row].exp().tolist() == pytest.approx([voxel] * 6)
    assert not added
    limited = random_scene(seed=seed)
    limited.grow(wanted, voxel, limit=len(before) + 2)
    assert len(limited.anchors) == len(before) + 2


def test_statistics_sum_gradients_and_opacities_by_anchor(camera):
    scene = random_scene()
    statistics = AnchorStatistics(scene.anchors, len(scene.anchors))
    sums = {name: torch.zeros_like(values) for name, values in vars(statistics).items()}
    for seed in range(3):
        camera.cam_to_world[:, 0, 3] = 0.3 * seed
        decoded = scene.decode(camera)
        means = decoded.gaussians.means
        of_means = torch.randn(means.shape, generator=torch.manual_seed(seed)).double()
        of_means[::3] = 0  # culled
        statistics.observe(decoded, of_means, camera)
        norms, _ = screen_gradients(means, of_means, camera)
        row = 0
        for index, anchor in enumerate(decoded.anchors.tolist()):
            sums["seen"][anchor] += 1
            sums["opacities"][anchor] += decoded.opacities[index].clamp_min(0).sum()
            for slot in range(OFFSETS):
                if decoded.shown[index, slot]:
                    if row % 3:
                        sums["gradients"][anchor, slot] += norms[row]
                        sums["shown"][anchor, slot] += 1
                    row += 1
        assert row == len(means) > 0
    for name, expected in sums.items():
        torch.testing.assert_close(getattr(statistics, name), expected, msg=name)


def refinement_of(views, points=None, **options) -> ScaffoldRefinement:
    settings = replace(SCAFFOLD_GS, **({"voxel": 0.05, "round": 10} | options))
    points = torch.rand(30, 3) + torch.tensor([0.0, 0, 2]) if points is None else points
    return ScaffoldRefinement(points, views, torch.zeros(3), settings, 0)


def test_anchors_grow_by_the_gradient_at_each_level_and_transparent_ones_go(small_room):
    refinement = refinement_of(small_room)
    scene, statistics, count = refinement.scene, refinement._statistics, 30
    assert len(scene.anchors) == count
    scene.optimizer.parameters["offsets"][:] = 100 * torch.randn(count, OFFSETS, 3)
    # Seen in more than 0.8 of the steps of a round, and a Gaussian in more than half of that.
    statistics.seen[:], statistics.shown[:] = 9, 5
    statistics.opacities[:] = 9 * MIN_OPACITY * 1.1
    statistics.opacities[3] = 9 * MIN_OPACITY * 0.9
    statistics.opacities[4], statistics.seen[4] = 0, 8
    statistics.gradients[:20] = 5 * 0.99 * GRADIENT
    statistics.gradients[20:] = 5 * 4 * GRADIENT
    statistics.shown[29] = 4
    gone, kept = scene.anchors[3].clone(), scene.anchors[4].clone()
    calls = []
    grow = scene.grow
    scene.grow = lambda wanted, *rest: calls.append((wanted, *rest)) or grow(wanted, *rest)
    refinement.densify()
    assert [round(size / 0.05) for _, size, _ in calls] == [16, 4, 1]
    for (wanted, *_), fraction in zip(calls, (0.5, 0.75, 0.875), strict=True):
        assert not wanted[:20].any()
        assert not wanted[29:].any()
        assert wanted[20:29].float().mean() == pytest.approx(fraction, abs=0.15)
    assert len(scene.anchors) > count
    assert not (scene.anchors == gone).all(1).any()
    assert (scene.anchors == kept).all(1).any()
    for values in vars(statistics).values():
        assert len(values) == len(scene.anchors)
    assert statistics.seen.sum() == 8  # the anchor that was not seen often enough
    assert statistics.shown.sum() == 4 * OFFSETS
    assert scene.optimizer.num_rows == len(scene.anchors)


def test_growth_keeps_to_its_steps_and_to_its_end(small_room):
    options = {"first_statistics": 4, "first_round": 6, "round": 4}
    refinement, rounds, observed = refinement_of(small_room, **options), [], []
    refinement.densify = lambda: rounds.append(refinement._steps)
    refinement._statistics.observe = lambda *_: observed.append(refinement._steps - 1)
    for step in range(40):
        refinement.advance(step / 40)
    assert rounds == [8, 12, 16]
    assert observed == list(range(4, 20))


@pytest.mark.medium
def test_a_scene_becomes_better_grows_and_repeats(room, start):
    views, between = room
    settings = replace(
        SCAFFOLD_GS, voxel=0.01, first_statistics=10, first_round=40, round=20, max_gaussians=30_000
    )
    counts, quality = [], []

    def watch(progress, refinement):
        counts.append(progress.gaussians)
        quality.append(progress.psnr)
        return False

    scenes = [
        refine_scaffold(start, views, settings, steps=150, seed=seed, watch=watch)
        for seed in (0, 0, 1)
    ]
    background = views.mean_color()
    images = [scene.render(between.cameras, background).image for scene in scenes]
    psnr = [-10 * (image - between.images).square().mean().log10().item() for image in images]
    before = render(start, between.cameras, background).image
    assert min(psnr) > -10 * (before - between.images).square().mean().log10().item() + 3
    assert quality[149] > quality[20] + 5
    assert torch.equal(images[0], images[1])
    assert not torch.equal(images[0], images[2])
    assert counts[0] < counts[149] <= 30_000
    assert scenes[0].num_gaussians == counts[149]
