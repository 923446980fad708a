"""The kernels of "cuda" compile for GPUs that are not at hand: what the interpreter takes, the
compiler may not."""

import pytest
import torch
from compiler import compiled

from asysplat.rendering import render

pytest.importorskip("triton")

pytestmark = pytest.mark.medium

KERNELS = {
    "project",
    "list_tiles",
    "rasterize",
    "rasterize_backward",
    "sum_pairs",
    "project_backward",
}


@pytest.fixture(params=[80, 90], ids="sm_{}".format)
def launched(request, monkeypatch):
    """Kernels are compiled in the place of being run; every Gaussian is left with one pair."""
    from triton.runtime.jit import JITFunction

    kernels = {}

    def run(kernel, *, grid, warmup, **arguments):
        kernels[kernel.fn.__name__] = compiled(kernel, dict(arguments), request.param)
        for name, value in arguments.items():
            if name in ("depths", "counts"):
                value.fill_(1)
            elif isinstance(value, torch.Tensor) and not value.is_floating_point():
                value.fill_(0)

    monkeypatch.setattr(JITFunction, "run", run)
    monkeypatch.setattr("asysplat.rendering.cuda.draw.INTERPRETED", True)
    return kernels


@pytest.mark.parametrize(
    "options", [{}, {"depth": "median", "antialiased": True, "sh_degree": 0}], ids=str
)
def test_all_kernels_compile(make_scene, launched, options):
    gaussians, cameras = make_scene(dtype=torch.float32, degree=3)
    cameras.cam_to_world.requires_grad_()
    gaussians.sh.requires_grad_()
    masks = torch.ones(1, cameras.height, cameras.width, dtype=torch.bool)
    out = render(gaussians, cameras, backend="cuda", masks=masks, **options)
    out.image.sum().backward()
    assert set(launched) == KERNELS
    for name, kernel in launched.items():
        assert kernel.asm["cubin"], name
