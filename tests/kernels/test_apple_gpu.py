"""Apple's GPU, which is pretended: torch computes there, or a sentence says that it cannot."""

import pytest
import torch
from pretend_device import APPLE, pretended_device

from asysplat import ops
from asysplat.errors import InputError
from asysplat.geometry.motion import transform
from asysplat.kernels.self_check import relative_error
from asysplat.models.prior.projections import PairwiseProjections
from asysplat.ops.plane_sweep import load_backend
from asysplat.refinement.densification.relocate import split_opacity_and_scale
from asysplat.refinement.init import merge_to_limit
from asysplat.rendering import render
from asysplat.scene import Gaussians

NO_FLOAT64 = r"^Apple's GPU \(mps\) has no float64.* to the CPU with .to\('cpu'\)\.$"


@pytest.fixture
def apple(monkeypatch):
    with pretended_device(monkeypatch, APPLE) as device:
        with pytest.raises(TypeError, match="float64"):
            torch.zeros(2, device=device).double()
        yield device


def check(function, inputs, device):
    """Compare the results, and the gradients of their sum, with those of the CPU."""
    results = []
    for place in ("cpu", device):
        leaves = [tensor.detach().to(place).requires_grad_() for tensor in inputs]
        outputs = function(*leaves)
        assert {output.device.type for output in outputs} == {torch.device(place).type}
        grads = torch.autograd.grad(sum(output.sum() for output in outputs), leaves)
        results.append([tensor.detach().to("cpu") for tensor in (*outputs, *grads)])
    assert relative_error(*results) <= 1e-5


@pytest.mark.parametrize(
    "name, tail, decays", [("ssd", (2, 4), (2,)), ("selective_scan", (3,), (3, 5))]
)
def test_scans_are_computed_by_torch(apple, name, tail, decays):
    x, B, C = torch.randn(1, 9, *tail), torch.randn(1, 9, 5), torch.randn(1, 9, 5)
    dt, A, D = torch.rand(1, 9, tail[0]), -torch.rand(decays), torch.randn(tail[0])
    check(lambda *inputs: [getattr(ops, name)(*inputs)], (x, dt, A, B, C, D), apple)


def test_a_scene_is_rendered_by_torch(apple, make_scene):
    gaussians, cameras = make_scene(dtype=torch.float32)

    def draw(*fields):
        scene = Gaussians(*fields)
        out = render(scene, cameras.to(scene.means.device))
        return out.image, out.alpha, out.depth

    names = ("means", "quats", "scales", "opacities", "sh")
    check(draw, [getattr(gaussians, name) for name in names], apple)


def test_costs_are_computed_by_torch(apple):
    images, edges = torch.rand(1, 2, 12, 16), torch.rand(1, 2, 2, 12, 16)
    motions = torch.eye(3, 4).repeat(1, 2, 1, 1, 1)
    motions[..., 3] = torch.tensor([3.0, 0.5, 0.1])
    inputs = (images, torch.tensor([[[1], [0]]]), motions, torch.tensor([0.2, 1.0]).repeat(1, 2, 1))
    results = []
    for place in ("cpu", apple):
        moved = [tensor.to(place) for tensor in inputs]
        backend = load_backend("auto", moved[0])
        costs = backend.cost_volume(*moved, 16)
        best = backend.sgm(costs, torch.ones_like(moved[0]), edges.to(place))
        results.append([tensor.to("cpu") for tensor in (costs, best.contrast)])
    assert relative_error(*results) <= 1e-4


def test_kernels_that_are_not_there_are_named(apple, make_scene):
    scene = [part.to(apple) for part in make_scene(dtype=torch.float32)]
    for backend in ("cpu", "cuda"):
        with pytest.raises(InputError, match=rf"'{backend}'.* on mps.* choose 'auto'"):
            render(*scene, backend=backend)


def test_what_needs_float64_says_so(apple, make_scene):
    scene = make_scene(views=3, dtype=torch.float32)
    gaussians, cameras = (part.to(apple) for part in scene)
    copies = torch.ones_like(gaussians.opacities, dtype=torch.int64)
    calls = (
        lambda: PairwiseProjections.from_cameras(cameras.map(lambda t: t[None])),
        lambda: transform(gaussians, torch.eye(4)),
        lambda: merge_to_limit(gaussians, cameras, 1.0, 4),
        lambda: split_opacity_and_scale(gaussians.opacities, gaussians.scales, copies),
    )
    for call in calls:
        with pytest.raises(InputError, match=NO_FLOAT64):
            call()
