"""The kernels of "cuda" compile for GPUs that are not at hand: what the interpreter takes, the
compiler may not."""

import pytest
import torch
from compiler import collect_kernels

from asysplat.rendering import render

pytest.importorskip("triton")

pytestmark = pytest.mark.medium

KERNELS = {
    *("project", "list_tiles", "rasterize", "rasterize_backward", "sum_pairs"),
    "project_backward",
}


def keep_one_pair(arguments):
    """Leave every Gaussian with one pair."""
    for name, value in arguments.items():
        if name in ("depths", "counts"):
            value.fill_(1)
        elif isinstance(value, torch.Tensor) and not value.is_floating_point():
            value.fill_(0)


OTHER = {"depth": "median", "antialiased": True, "sh_degree": 0}


@pytest.mark.parametrize(
    "architecture, options",
    [
        (90, {}),
        pytest.param(80, {}, marks=pytest.mark.slow),
        pytest.param(80, OTHER, marks=pytest.mark.slow),
        pytest.param(90, OTHER, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_all_kernels_compile(make_scene, monkeypatch, architecture, options):
    launched = collect_kernels(monkeypatch, architecture, fill=keep_one_pair)
    monkeypatch.setattr("asysplat.rendering.cuda.draw.INTERPRETED", True)
    gaussians, cameras = make_scene(dtype=torch.float32, degree=3)
    cameras.cam_to_world.requires_grad_()
    gaussians.sh.requires_grad_()
    masks = torch.ones(1, cameras.height, cameras.width, dtype=torch.bool)
    out = render(gaussians, cameras, backend="cuda", masks=masks, **options)
    out.image.sum().backward()
    assert {kernel for kernel, *_ in launched} == KERNELS
    assert all(kernel.asm["cubin"] for kernel in launched.values())
